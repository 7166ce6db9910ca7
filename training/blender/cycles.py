"""Build scenes in Blender and render them with Cycles. This is the only module that imports bpy.

Every light is in a separate light group, so one pass renders the pictures of all lights. Materials carry a
second, white matte surface, which one shared value switches on. With it and without bounces, a second pass
renders all Lumi maps. The white surface keeps cut-outs and relief. White glass transmits the same share of
light as glass does, but shows as white.
"""

from __future__ import annotations

import math
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import bpy
import numpy as np
import OpenEXR
from mathutils import Matrix, Vector
from numpy.typing import NDArray

from dior_rt.training.blender.meshes import Finish, Mesh
from dior_rt.training.blender.probe import Hits
from dior_rt.training.blender.scene import BlenderScene, Camera, Gobo, Lamp, Panorama

Raster = NDArray[np.float32]

WORLD: Final = "W"
LAYER: Final = "ViewLayer."
IOR: Final = 1.45
RELIEF: Final = 0.02  # metres
BOX_BLEND: Final = 0.2  # how far box projections fade into each other


@dataclass(frozen=True)
class ShootOptions:
    """The options of a shot.

    resolution: side in pixels. samples, lumi_samples: per pixel, shared by all lights. bounces: those of
    light after the first surface. threads: the threads of Cycles. seed: the seed of its noise.
    """

    resolution: int = 128
    samples: int = 40
    lumi_samples: int = 40
    bounces: int = 4
    threads: int = 1
    seed: int = 0


@dataclass(frozen=True)
class Shot:
    """One view's rasters, with noise and at arbitrary strengths of the lights; names as in `store`.

    images, lumi: (K, H, W, 3), the world last. guide_albedo, guide_normals: for the denoiser. normals: (H, W,
    3) in the scene's space.
    """

    images: Raster
    lumi: Raster
    normals: Raster
    depth: Raster
    albedo: Raster
    sky: Raster
    ids: Raster
    guide_albedo: Raster
    guide_normals: Raster


class Studio:
    """A scene built in Blender. A process has one Blender, so one studio at a time."""

    def __init__(self, scene: BlenderScene, panorama_file: Path | None, options: ShootOptions) -> None:
        self.options = options
        self._files = tempfile.TemporaryDirectory()
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self._scene = bpy.context.scene
        self._layer = self._scene.view_layers[0]
        _configure(self._scene, self._layer, options)
        self._paper = _paper_switch()
        self._lamps: list[Any] = []
        made: dict[int, Any] = {}
        for index, thing in enumerate(scene.things):
            if id(thing.mesh) not in made:
                made[id(thing.mesh)] = _mesh(thing.mesh, self._paper)
            placed = bpy.data.objects.new(f"thing{index}", made[id(thing.mesh)])
            placed.matrix_world = Matrix(thing.matrix().tolist())
            placed.pass_index = index + 1
            self._scene.collection.objects.link(placed)
        self._world = _world(self._scene, scene.panorama, panorama_file) if panorama_file else None
        bpy.context.view_layer.update()
        self._graph = bpy.context.evaluated_depsgraph_get()

    def __enter__(self) -> Studio:
        return self

    def __exit__(self, *failure: object) -> None:
        self._files.cleanup()

    def cast(self, origin: NDArray[np.float64], directions: NDArray[np.float64], reach: float = 1e6) -> Hits:
        """Return what rays from a point hit within `reach`."""
        start = Vector(origin)
        found = [self._scene.ray_cast(self._graph, start, Vector(way), distance=reach) for way in directions]
        return Hits(
            hit=np.array([one[0] for one in found]),
            at=np.array([one[1] for one in found], float),
            normal=np.array([one[2] for one in found], float),
            thing=np.array([one[4].pass_index - 1 if one[0] else -1 for one in found]),
        )

    def shoot(self, camera: Camera, lamps: Sequence[Lamp]) -> Shot:
        """Render a camera's view under every lamp and the world, each alone."""
        self._light(lamps)
        self._point_camera(camera)
        groups = [f"L{k}" for k in range(len(lamps))] + ([WORLD] if self._world else [])
        for name in groups:
            if name not in self._layer.lightgroups:
                self._layer.lightgroups.add(name=name)
        picture = self._render("picture", paper=False)
        white = self._render("lumi", paper=True)
        albedo = _channels(picture, "DiffCol", "RGB") + _channels(picture, "GlossCol", "RGB")
        return Shot(
            images=np.stack([_channels(picture, f"Combined_{name}", "RGB") for name in groups]),
            lumi=np.stack([_channels(white, f"Combined_{name}", "RGB") for name in groups]),
            normals=_channels(picture, "Normal", "XYZ"),
            depth=_channels(picture, "Depth", "Z"),
            albedo=albedo.clip(0, 1),
            sky=(1 - _channels(white, "Combined", "A")).clip(0, 1),
            ids=_channels(picture, "IndexOB", "X"),
            guide_albedo=_channels(picture, "Denoising Albedo", "RGB").clip(0, 1),
            guide_normals=_channels(picture, "Denoising Normal", "XYZ"),
        )

    def _light(self, lamps: Sequence[Lamp]) -> None:
        """Set the lamps. The objects stay from view to view.

        Cycles orders lights by when it first saw them, and their order decides which light a random number
        picks.
        """
        while len(self._lamps) < len(lamps):
            placed = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "POINT"))
            placed.visible_camera = False
            placed.lightgroup = f"L{len(self._lamps)}"
            self._scene.collection.objects.link(placed)
            self._lamps.append(placed)
        for k, placed in enumerate(self._lamps):
            placed.hide_render = k >= len(lamps)
            if k < len(lamps):
                _set_lamp(placed, lamps[k])

    def _point_camera(self, camera: Camera) -> None:
        if self._scene.camera is None:
            self._scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
            self._scene.collection.objects.link(self._scene.camera)
        self._scene.camera.data.angle = math.radians(camera.fov)
        self._scene.camera.data.clip_start = 0.01
        pose = np.eye(4)
        pose[:3, :3] = camera.axes().T
        pose[:3, 3] = camera.at
        self._scene.camera.matrix_world = Matrix(pose.tolist())

    def _render(self, name: str, paper: bool) -> dict[str, Any]:
        """Render to a file of many channels and read it: the white surfaces without bounces, or the scene."""
        options, cycles = self.options, self._scene.cycles
        bounces = 0 if paper else options.bounces
        cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = bounces
        cycles.samples = options.lumi_samples if paper else options.samples
        cycles.seed = options.seed * 2 + paper
        self._paper.nodes["paper"].outputs[0].default_value = float(paper)
        self._scene.render.film_transparent = paper
        path = Path(self._files.name) / f"{name}.exr"
        self._scene.render.filepath = str(path)
        with _quiet():
            bpy.ops.render.render(write_still=True)
        return OpenEXR.File(str(path), separate_channels=True).channels()


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Blender's line per sample on the terminal. It bypasses Python and goes to the process's
    output.
    """
    sys.stdout.flush()
    shown, hidden = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(hidden, 1)
        yield
    finally:
        os.dup2(shown, 1)
        os.close(shown)
        os.close(hidden)


def _channels(rendered: dict[str, Any], name: str, letters: str) -> Raster:
    parts = [np.asarray(rendered[f"{LAYER}{name}.{letter}"].pixels, np.float32) for letter in letters]
    return parts[0] if len(parts) == 1 else np.stack(parts, -1)


def _configure(scene: Any, layer: Any, options: ShootOptions) -> None:
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.resolution_x = render.resolution_y = options.resolution
    render.use_persistent_data = True  # keeps the geometry between the passes and views
    render.threads_mode, render.threads = "FIXED", options.threads
    render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
    render.image_settings.color_depth = "32"
    render.image_settings.exr_codec = "NONE"
    cycles.device = "CPU"
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.use_light_tree = False  # every light gets the same share of the samples
    cycles.sample_clamp_indirect = 10.0
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.transmission_bounces = 2
    cycles.transparent_max_bounces = 12
    layer.use_pass_normal = layer.use_pass_z = layer.use_pass_object_index = True
    layer.use_pass_diffuse_color = layer.use_pass_glossy_color = True
    layer.cycles.denoising_store_passes = True


def _paper_switch() -> Any:
    """Return a node group with one value: 1 makes every surface white and matte."""
    group = bpy.data.node_groups.new("paper", "ShaderNodeTree")
    group.interface.new_socket("paper", in_out="OUTPUT", socket_type="NodeSocketFloat")
    value, out = group.nodes.new("ShaderNodeValue"), group.nodes.new("NodeGroupOutput")
    value.name = "paper"
    group.links.new(value.outputs[0], out.inputs[0])
    return group


def _mesh(mesh: Mesh, paper: Any) -> Any:
    made = bpy.data.meshes.new("mesh")
    count = len(mesh.faces)
    made.vertices.add(len(mesh.vertices))
    made.vertices.foreach_set("co", np.ascontiguousarray(mesh.vertices, np.float32).ravel())
    made.loops.add(3 * count)
    made.loops.foreach_set("vertex_index", np.ascontiguousarray(mesh.faces, np.int32).ravel())
    made.polygons.add(count)
    made.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
    made.polygons.foreach_set("material_index", np.ascontiguousarray(mesh.slots, np.int32))
    made.polygons.foreach_set("use_smooth", np.ones(count, bool))
    if mesh.uv is not None:
        layer = made.uv_layers.new()
        layer.uv.foreach_set("vector", np.ascontiguousarray(mesh.uv, np.float32).ravel())
    for finish in mesh.finishes:
        made.materials.append(_material(finish, paper))
    made.validate()
    made.update()
    made.set_sharp_from_angle(angle=math.radians(mesh.smooth))
    return made


class _Nodes:
    """A node tree with short methods to add nodes to it."""

    def __init__(self, tree: Any) -> None:
        self.tree = tree

    def add(self, kind: str, *inputs: Any, **properties: Any) -> Any:
        """Add a node with its inputs set in order (None leaves one unchanged), and return it."""
        node = self.tree.nodes.new(kind)
        for name, value in properties.items():
            setattr(node, name, value)
        for socket, value in zip(node.inputs, inputs, strict=False):
            self.set(socket, value)
        return node

    def set(self, socket: Any, value: Any) -> None:
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, socket)
        elif isinstance(value, bpy.types.Node):
            self.tree.links.new(value.outputs[0], socket)
        elif value is not None:
            socket.default_value = value

    def math(self, operation: str, *inputs: Any) -> Any:
        return self.add("ShaderNodeMath", *inputs, operation=operation)


def _material(finish: Finish, paper: Any) -> Any:
    made = bpy.data.materials.new("material")
    made.use_nodes = True
    made.node_tree.nodes.clear()
    nodes = _Nodes(made.node_tree)
    texture = _texture(nodes, finish) if finish.texture is not None else None
    color: Any = (*finish.color, 1.0)
    if texture:
        color = nodes.add("ShaderNodeMix", data_type="RGBA", blend_type="MULTIPLY", clamp_result=True)
        nodes.set(color.inputs["Factor"], 1.0)
        nodes.set(color.inputs[6], texture.outputs["Color"])
        nodes.set(color.inputs[7], (*finish.color, 1.0))
        color = color.outputs[2]
    relief = None
    if texture and finish.bump:
        relief = nodes.add("ShaderNodeBump")
        nodes.set(relief.inputs["Strength"], finish.bump)
        nodes.set(relief.inputs["Distance"], RELIEF)
        nodes.set(relief.inputs["Height"], texture.outputs["Color"])
    surface = _surface(nodes, finish, color, relief)
    white = nodes.add("ShaderNodeBsdfDiffuse", (1, 1, 1, 1))
    nodes.set(white.inputs["Normal"], relief)
    if finish.glass:
        path = nodes.add("ShaderNodeLightPath")
        passing = nodes.math("MULTIPLY", path.outputs["Is Shadow Ray"], finish.glass)
        white = nodes.add("ShaderNodeMixShader", passing, white, nodes.add("ShaderNodeBsdfTransparent"))
    switch = nodes.add("ShaderNodeGroup", node_tree=paper)
    shown = nodes.add("ShaderNodeMixShader", switch, surface, white)
    if texture and finish.texture is not None and finish.texture.shape[2] == 4:
        clear = nodes.add("ShaderNodeBsdfTransparent")
        shown = nodes.add("ShaderNodeMixShader", texture.outputs["Alpha"], clear, shown)
    nodes.add("ShaderNodeOutputMaterial", shown)
    return made


def _surface(nodes: _Nodes, finish: Finish, color: Any, relief: Any) -> Any:
    body = nodes.add("ShaderNodeBsdfPrincipled")
    for name, value in (
        ("Base Color", color),
        ("Roughness", finish.roughness),
        ("Metallic", finish.metallic),
        ("Normal", relief),
    ):
        nodes.set(body.inputs[name], value)
    if not finish.glass:
        return body
    clear = nodes.add("ShaderNodeBsdfTransparent", (*finish.color, 1.0))
    inside = nodes.add("ShaderNodeMixShader", finish.glass, body, clear)
    mirror = nodes.add("ShaderNodeBsdfAnisotropic")
    nodes.set(mirror.inputs["Roughness"], finish.roughness)
    return nodes.add("ShaderNodeMixShader", nodes.add("ShaderNodeFresnel", IOR), inside, mirror)


def _texture(nodes: _Nodes, finish: Finish) -> Any:
    raster = finish.texture
    assert raster is not None
    height, width, bands = raster.shape
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :bands] = raster[::-1].astype(np.float32) / 255
    image = bpy.data.images.new("texture", width, height, alpha=bands == 4)
    image.alpha_mode = "CHANNEL_PACKED"
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    node = nodes.add("ShaderNodeTexImage", image=image)
    if finish.box:
        node.projection, node.projection_blend = "BOX", BOX_BLEND
        place = nodes.add("ShaderNodeTexCoord")
        scaled = nodes.add("ShaderNodeMapping")
        nodes.set(scaled.inputs["Vector"], place.outputs["Object"])
        nodes.set(scaled.inputs["Scale"], (finish.box,) * 3)
        nodes.set(node.inputs["Vector"], scaled)
    return node


def _world(scene: Any, panorama: Panorama, file: Path) -> Any:
    world = bpy.data.worlds.new("world")
    scene.world = world
    world.use_nodes = True
    world.lightgroup = WORLD
    nodes = _Nodes(world.node_tree)
    picture = nodes.add(
        "ShaderNodeTexEnvironment", image=bpy.data.images.load(str(file), check_existing=True)
    )
    turned = nodes.add("ShaderNodeMapping")
    nodes.set(turned.inputs["Vector"], nodes.add("ShaderNodeTexCoord").outputs["Generated"])
    nodes.set(turned.inputs["Rotation"], (0, 0, panorama.turn))
    nodes.set(picture.inputs["Vector"], turned)
    nodes.set(world.node_tree.nodes["Background"].inputs["Color"], picture)
    return world


def _set_lamp(placed: Any, lamp: Lamp) -> None:
    """Turn a light object into a lamp that lights its target as strongly as any other lamp does."""
    placed.data.type = lamp.kind.upper()
    data = placed.data
    far = math.dist(lamp.at, lamp.target)
    if lamp.kind == "sun":
        data.energy, data.angle = 1.0, math.radians(lamp.size)
    elif lamp.kind == "area":
        data.energy, data.size = math.pi * (far**2 + lamp.size**2), lamp.size
    else:
        data.energy, data.shadow_soft_size = 4 * math.pi**2 * far**2, lamp.size
    if lamp.kind == "spot":
        data.spot_size, data.spot_blend = math.radians(lamp.cone), lamp.blend
    placed.location = lamp.at
    placed.rotation_euler = Vector(lamp.direction()).to_track_quat("-Z", "Y").to_euler()
    data.use_nodes = lamp.gobo is not None
    if lamp.gobo:
        _cut(data, lamp, lamp.gobo)


def _cut(data: Any, lamp: Lamp, gobo: Gobo) -> None:
    """Let the lamp shine only through its gobo: a factor on its strength by direction."""
    ahead = lamp.direction()
    across = np.cross(ahead, [0.13, 0.21, 0.97])
    across /= np.linalg.norm(across)
    up = np.cross(across, ahead)
    c, s = math.cos(gobo.turn), math.sin(gobo.turn)
    data.node_tree.nodes.clear()
    nodes = _Nodes(data.node_tree)
    way = nodes.add("ShaderNodeNewGeometry").outputs["Incoming"]

    def along(axis: NDArray[np.float64]) -> Any:
        return nodes.add("ShaderNodeVectorMath", way, tuple(axis), operation="DOT_PRODUCT").outputs["Value"]

    depth = nodes.math("MAXIMUM", nodes.math("ABSOLUTE", along(ahead)), 1e-3)
    u = nodes.math("SUBTRACT", nodes.math("DIVIDE", along(c * across + s * up), depth), gobo.shift)
    v = nodes.math("DIVIDE", along(c * up - s * across), depth)

    def step(value: Any, edge: float, width: float) -> Any:
        """Return 0 below the edge and 1 above, with a smooth transition."""
        node = nodes.add("ShaderNodeMapRange", interpolation_type="SMOOTHSTEP")
        for socket, value_or_edge in zip(
            node.inputs, (value, edge - width / 2, edge + width / 2), strict=False
        ):
            nodes.set(socket, value_or_edge)
        return node

    def inside(value: Any, half: float) -> Any:
        return nodes.math("SUBTRACT", 1.0, step(nodes.math("ABSOLUTE", value), half, gobo.soft * half))

    if gobo.kind == "flag":
        pattern = step(u, 0.0, gobo.soft * gobo.size)
    elif gobo.kind == "slats":
        wave = nodes.math("SINE", nodes.math("MULTIPLY", u, 2 * math.pi / gobo.size))
        pattern = step(wave, 0.0, 2 * gobo.soft)
    elif gobo.kind == "window":
        bar = 0.12 * gobo.size
        frame = nodes.math("MULTIPLY", inside(u, gobo.size), inside(v, gobo.size * 1.3))
        open_u, open_v = (nodes.math("SUBTRACT", 1.0, inside(value, bar)) for value in (u, v))
        pattern = nodes.math("MULTIPLY", frame, nodes.math("MULTIPLY", open_u, open_v))
    else:
        place = nodes.add("ShaderNodeCombineXYZ", u, v, gobo.turn)
        noise = nodes.add("ShaderNodeTexNoise")
        nodes.set(noise.inputs["Vector"], place)
        nodes.set(noise.inputs["Scale"], 1 / gobo.size)
        pattern = step(noise.outputs[0], 0.5, 0.3 * gobo.soft + 0.02)
    shine = nodes.add("ShaderNodeEmission", (1, 1, 1, 1), pattern)
    nodes.add("ShaderNodeOutputLight", shine)
