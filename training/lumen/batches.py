"""Make training samples on the device: mixed lights, a camera, crops and strokes, all as batched torch
operations.

A photo is the sum of its sources' pictures, each with a strength and a colour. Its Lumi map is the same sum
of their Lumi maps. The photo's own lights are near white, as most real light is. Drawn light may have any
colour.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from dior_rt.training.light import encode_lumi, linear_to_srgb, srgb_to_linear
from dior_rt.training.lumen.brush import Brush, draw, random_brush, starts, touched
from dior_rt.training.lumen.camera import random_cameras
from dior_rt.training.lumen.completion import FACTOR_SCALE, Strokes
from dior_rt.training.lumen.lamps import at, cells_at, lamps_along, nearest, positions
from dior_rt.training.lumen.materials import factors
from dior_rt.training.lumen.optics import luminance
from dior_rt.training.lumen.strokes import ADD, LEAST_FACTOR, MULTIPLY, SET, peak
from dior_rt.training.lumen.views import Views, from_code

#: The kinds of change between photo and relit picture, and their frequencies.
LAMP, CHANGE, REPLACE, LOCAL, KEEP = range(5)
SHARES: Final = (0.27, 0.18, 0.20, 0.27, 0.08)
SATURATED: Final = 0.08  # share of photos with a light of any hue
DENSE, COARSE = 0.08, 0.08  # shares of `set` samples that get the whole map, or coarse parts of it
SKY_ID: Final = 255
BRIGHTEST: Final = 100.0  # the largest light of a sample; encoded, 3.04


@dataclass(frozen=True)
class Truth:
    """The targets of the network, (B, ., H, W) each."""

    light: Tensor  # 3, source Lumi map
    target: Tensor  # 3, target Lumi map
    x0: Tensor  # 3, the flow's data variable
    relit: Tensor  # 3, the relit picture, sRGB-encoded
    style: Tensor  # 3, the photo without noise, sRGB-encoded
    normal: Tensor  # 3
    depth: Tensor  # 1, logarithm
    albedo: Tensor  # 3, sRGB-encoded
    sky: Tensor  # 1, 1 where the sky is


@dataclass(frozen=True)
class Batch:
    """Inputs and truth."""

    photo: Tensor
    strokes: Strokes
    truth: Truth
    kind: Tensor  # (B,) LAMP .. KEEP


@dataclass(frozen=True)
class Scenery:
    """A crop of each view, decoded, (B, ., H, W)."""

    images: Tensor  # (B, K, 3, H, W)
    lumi: Tensor  # (B, K, 3, H, W)
    usable: Tensor  # (B, K)
    world: Tensor  # (B, K)
    normal: Tensor
    albedo: Tensor
    position: Tensor
    depth: Tensor
    ids: Tensor
    sky: Tensor


@dataclass(frozen=True)
class Lit:
    """Photo and relit picture, linear, and their Lumi maps."""

    photo: Tensor
    light: Tensor
    relit: Tensor
    target: Tensor

    def changed(self, where: Tensor, relit: Tensor, target: Tensor) -> Lit:
        """Return the same photo, with another relit picture and target where `where` (B, 1, 1, 1) is set."""
        return replace(
            self, relit=torch.where(where, relit, self.relit), target=torch.where(where, target, self.target)
        )


class BatchMaker:
    """Makes batches of `count` samples of `side` x `side` cells from views on a device.

    The n-th batch of a seed is the same on every run on one kind of device.
    """

    def __init__(
        self, views: Views, count: int, seed: int, side: int | None = None, tiles: Tensor | None = None
    ) -> None:
        """tiles: (N, 3, 128, 128) uint8 surfaces for new materials, on the views' device."""
        self.views, self.count, self.seed, self.side = views, count, seed, side or views.size
        self.tiles = views.albedo.new_zeros(0, 3, 1, 1) if tiles is None else tiles
        self.device = views.images.device
        self.cell_slope = float(views.slope.mean()) * 2 / self.side  # side of a cell at distance 1, roughly
        self.generator = Generator(device=self.device)

    def make(self, number: int) -> Batch:
        self.generator.manual_seed(self.seed * 1_000_003 + number)
        scenery = self._scenery()
        kind = self._choose(SHARES)
        lights, relights, blend, far = self._lights(scenery, kind)
        photo, light = mix(scenery, lights)
        relit, target = mix(scenery, relights)
        exposure = self._exposure(photo, light)
        photo, light, relit, target = (part * exposure for part in (photo, light, relit, target))
        relit, target = self._balanced(kind, photo, light, relit, target)
        scene = Lit(photo, light, relit, target)
        brush = random_brush(self.count, self.side, self.generator, self.device)
        scene, first = self._local(scenery, kind, blend, scene, brush)
        strokes, scene = self._draw(scenery, kind, blend, far, scene, brush, first)
        strokes, scene = usual(strokes, scene)
        cameras = random_cameras(self.count, self.generator, self.device)
        shot = cameras.shoot(photo, self.generator)
        truth = Truth(
            light=scene.light,
            target=scene.target,
            x0=data_variable(strokes, scene.light, scene.target),
            relit=cameras.develop(scene.relit),
            style=cameras.develop(photo),
            normal=scenery.normal,
            depth=torch.log(scenery.depth),
            albedo=scenery.albedo,
            sky=scenery.sky,
        )
        return Batch(shot, strokes, truth, kind)

    # Random numbers
    # ---------------------------------------------------------------------------------------------

    def _uniform(self, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=self.generator, device=self.device)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.generator, device=self.device)

    def _choose(self, shares: tuple[float, ...]) -> Tensor:
        table = torch.tensor(shares, device=self.device)
        return torch.multinomial(table, self.count, replacement=True, generator=self.generator)

    # Views
    # ------------------------------------------------------------------------------------------------------

    def _scenery(self) -> Scenery:
        """Return a random crop of a random view for each sample, mirrored half of the time."""
        views, count = self.views, self.count
        which = torch.randint(len(views), (count,), generator=self.generator, device=self.device)
        scale = self._uniform(count, low=0.55)
        mirror = torch.where(self._uniform(count) < 0.5, -1.0, 1.0)
        shift = (1 - scale[:, None]) * self._uniform(count, 2, low=-1.0)
        line = (torch.arange(self.side, device=self.device) + 0.5) * (2 / self.side) - 1
        x = mirror[:, None] * line * scale[:, None] + shift[:, :1]  # (B, side) in the full picture, -1..1
        y = line * scale[:, None] + shift[:, 1:]
        grid = torch.stack(
            [x[:, None, :].expand(-1, self.side, -1), y[:, :, None].expand(-1, -1, self.side)], dim=3
        )  # (B, side, side, 2)

        def cut(rasters: Tensor, mode: str = "bilinear") -> Tensor:
            return F.grid_sample(rasters, grid, mode=mode, padding_mode="border", align_corners=False)

        k = views.images.shape[1]
        most = views.image_most[which][:, :, None, None, None]
        images = cut(from_code(views.images[which], most).flatten(1, 2)).unflatten(1, (k, 3))
        most = views.lumi_most[which][:, :, None, None, None]
        lumi = cut(from_code(views.lumi[which], most).flatten(1, 2)).unflatten(1, (k, 3))
        ids = cut(views.ids[which].float(), "nearest")
        sky = (ids == SKY_ID).float()
        # The environment is seen directly in the sky. Its light there is taken to be its mean on the ground.
        ground = (1 - sky)[:, None]
        mean = (lumi * ground).sum(dim=(3, 4), keepdim=True) / ground.sum(dim=(3, 4), keepdim=True).clamp_min(
            1
        )
        lumi = torch.where(sky[:, None] > 0, mean * views.world[which][:, :, None, None, None], lumi)
        factor = factors(ids, self.tiles, self.generator)
        images = images * factor[:, None]
        albedo = (srgb_to_linear(cut(views.albedo[which].float() / 255)) * factor).clamp(0, 1)
        normal = cut(views.normal[which].float() / 127.5 - 1)
        normal = F.normalize(normal, dim=1, eps=1e-4) * (1 - sky)
        near, far = views.depth_range[which].split(1, dim=1)
        code = cut(views.depth[which].float()) / 255
        depth = torch.exp(near[:, :, None, None] + code * (far - near)[:, :, None, None])
        frame = torch.stack([grid[..., 0], -grid[..., 1]], dim=1)
        position = positions(depth, views.slope[which], frame)
        flip = torch.stack([mirror, torch.ones_like(mirror), torch.ones_like(mirror)], dim=1)[
            :, :, None, None
        ]
        # A source must light something of this crop.
        lit = luminance(lumi.flatten(0, 1)).unflatten(0, (count, k)).mean(dim=(2, 3, 4)) > 0.02
        return Scenery(
            images=images,
            lumi=lumi,
            usable=views.usable[which] & lit,
            world=views.world[which],
            normal=normal * flip,
            albedo=linear_to_srgb(albedo),
            position=position * flip,
            depth=depth,
            ids=ids,
            sky=sky,
        )

    # Lights
    # -----------------------------------------------------------------------------------------------------

    def _neutral(self, *shape: int) -> Tensor:
        """Return colours on the line from warm to cool, a few of any hue, of luminance 1: (*shape, 3)."""
        warmth = 0.16 * self._normal(*shape)
        colour = torch.exp(torch.stack([warmth, torch.zeros_like(warmth), -1.4 * warmth], dim=-1))
        return torch.where(self._uniform(*shape, 1) < SATURATED, self._any(*shape), _unit(colour))

    def _any(self, *shape: int) -> Tensor:
        """Return colours of any hue, white one time in three, of luminance 1: (*shape, 3)."""
        hue = self._uniform(*shape, 1) * 6
        rainbow = ((hue + torch.tensor([0.0, 4.0, 2.0], device=self.device)) % 6 - 3).abs().sub(1).clamp(0, 1)
        saturation = self._uniform(*shape, 1) ** 0.7 * (self._uniform(*shape, 1) > 0.33)
        return _unit(1 - 0.97 * saturation * (1 - rainbow))

    def _lights(self, scenery: Scenery, kind: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return strength times colour (B, K, 3) of the photo's sources and of the relit picture's; blend;
        far.
        """
        count, k = scenery.usable.shape
        usable = scenery.usable.float()
        often = torch.where(scenery.world, 0.7, 0.35)
        on = self._switch(often, usable)
        strength = 2 ** self._uniform(count, k, low=-2.0, high=1.0)
        lights = (on * strength)[:, :, None] * self._neutral(count, k)
        pick = F.one_hot(torch.multinomial(usable + 1e-6, 1, generator=self.generator)[:, 0], k).float()
        # One lamp is added. It is off in the photo, unless it is the only lamp that could be on.
        others = on * (1 - pick)
        alone = others.sum(dim=1, keepdim=True) == 0
        is_lamp = (kind == LAMP)[:, None] & ~alone
        base = torch.where(is_lamp, others, on)
        lights = lights * (base / on.clamp_min(1e-6)).clamp(max=1)[:, :, None]
        lamp = 2 ** self._uniform(count, low=-2.0, high=2.5)
        added = lights + (pick * lamp[:, None])[:, :, None] * self._any(count)[:, None]
        # One light that is on is dimmed, switched off, strengthened or given another colour.
        lit = F.one_hot(torch.multinomial(base + 1e-9, 1, generator=self.generator)[:, 0], k).float()[
            :, :, None
        ]
        how = self._uniform(count, 1, 1)
        factor = torch.where(
            how < 0.3, torch.zeros_like(how), 2 ** self._uniform(count, 1, 1, low=-3.0, high=3.0)
        )
        gel = torch.where(how < 0.65, torch.ones_like(how), self._any(count)[:, None])
        changed = lights * (1 - lit + lit * factor * gel)
        empty = changed.sum(dim=(1, 2), keepdim=True) < 1e-6
        changed = torch.where(empty, lights * 0.3, changed)
        replaced = self._switch(torch.where(scenery.world, 0.4, 0.35), usable)[:, :, None]
        replaced = replaced * (2 ** self._uniform(count, k, low=-2.0, high=1.0))[:, :, None]
        replaced = replaced * torch.where(
            self._uniform(count, k, 1) < 0.5, self._neutral(count, k), self._any(count, k)
        )
        select = kind[:, None, None]
        relights = torch.where(select == LAMP, added, lights)
        relights = torch.where(select == CHANGE, changed, relights)
        relights = torch.where(select == REPLACE, replaced, relights)
        choice, decide = self._uniform(count), self._uniform(count)
        blend = torch.full_like(kind, SET)
        blend = torch.where((kind == LAMP) & (choice < 0.7), ADD, blend)
        blend = torch.where((kind == CHANGE) & (choice < 0.6), MULTIPLY, blend)
        blend = torch.where((kind == LOCAL) & (choice < 0.35), ADD, blend)
        blend = torch.where((kind == LOCAL) & (choice > 0.65), MULTIPLY, blend)
        blend = torch.where((kind == KEEP) & (choice < 0.3), MULTIPLY, blend)
        far = torch.where(kind == REPLACE, 1, (decide < 0.5).long())
        far = torch.where(kind == LOCAL, 0, far)
        return lights, relights, blend, far

    def _switch(self, often: Tensor, usable: Tensor) -> Tensor:
        """Return (B, K) 0 or 1: which usable sources are on. At least one is on."""
        on = (self._uniform(*usable.shape) < often).float() * usable
        one = torch.multinomial(usable + 1e-6, 1, generator=self.generator)[:, 0]
        return torch.where(on.sum(dim=1, keepdim=True) > 0, on, F.one_hot(one, usable.shape[1]).float())

    def _exposure(self, photo: Tensor, light: Tensor) -> Tensor:
        """Return (B, 3, 1, 1), which brings the 95th percentile to 0.3..1.1, and the light's mean colour
        towards white.
        """
        white = self._uniform(self.count, 1, 1, 1, low=0.3, high=1.1)
        mean = light.mean(dim=(2, 3), keepdim=True).clamp_min(1e-5)
        cast = (mean / luminance(mean)) ** -self._uniform(self.count, 1, 1, 1, low=0.2, high=1.0)
        cast = cast / luminance(cast)
        return cast * white / bright_part(photo * cast)

    def _balanced(
        self, kind: Tensor, photo: Tensor, light: Tensor, relit: Tensor, target: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the relit picture and the target at suitable strengths.

        Replaced lights are scaled to suit the display, and added lights to the usual strength.
        """
        white = 2 ** self._uniform(self.count, 1, 1, 1, low=-1.7, high=1.0)
        replaced = (kind == REPLACE)[:, None, None, None]
        scale = torch.where(replaced, white / bright_part(relit), torch.ones_like(white))
        relit, target = relit * scale, target * scale
        lamp = (kind == LAMP)[:, None, None, None]
        extra = torch.where(
            lamp, 2 ** self._uniform(self.count, 1, 1, 1, low=-2.5, high=1.0), torch.ones_like(white)
        )
        norm = torch.where(lamp, extra / bright_part((relit - photo).clamp_min(0)), torch.ones_like(white))
        norm = norm.clamp(max=1e3)
        return photo + norm * (relit - photo), light + norm * (target - light)

    # Local light
    # ------------------------------------------------------------------------------------------------

    def _local(
        self, scenery: Scenery, kind: Tensor, blend: Tensor, scene: Lit, brush: Brush
    ) -> tuple[Lit, Tensor]:
        """Put small lamps, or objects that block light, before the surface that one stroke of LOCAL samples
        touches.

        Returns the scene and the cell (B,) at which that stroke starts. A dab is a stroke without length.
        """
        height, width = scenery.depth.shape[2], scenery.depth.shape[3]
        index = torch.multinomial((1 - scenery.sky).flatten(1) + 1e-6, 1, generator=self.generator)[:, 0]
        is_local = kind == LOCAL
        lone = is_local & (self._uniform(self.count) < 0.6)
        brush.step[:, 0] = torch.where(lone, 0.0, brush.step[:, 0])
        radius = self.side * 0.03 * (0.14 / 0.03) ** self._uniform(self.count)
        brush.radius[:, 0] = torch.where(lone, radius, brush.radius[:, 0])
        brush.keeps[:, 0] &= ~lone | (self._uniform(self.count) < 0.3)
        brush.count[:] = torch.where(is_local, 1, brush.count)
        brush.flat[:] = brush.flat | lone
        mask, points = touched(brush, 0, index, scenery.ids)
        cells = cells_at(points, height, width)
        # The side of a cell in the scene, at the start of the stroke.
        cell = (at(scenery.depth, index) * self.cell_slope)[:, 0]
        distance = (
            brush.radius[:, 0].clamp_min(0.025 * self.side)
            * cell
            * 2 ** self._uniform(self.count, low=-0.3, high=1.2)
        )
        start = at(scenery.position, index)
        on = torch.stack([(at(scenery.position, c) - start).norm(dim=1) for c in cells.unbind(1)], dim=1)
        on = (on < 8 * distance[:, None]).float()
        aside = 0.6 * self._normal(self.count, 3)
        shape = lamps_along(scenery.position, scenery.normal, cells, distance, aside, on) * (1 - scenery.sky)
        level = (shape * mask).sum(dim=(2, 3), keepdim=True) / mask.sum(dim=(2, 3), keepdim=True).clamp_min(1)
        shape = (shape / level.clamp_min(1e-9)).clamp(max=3.0)
        # New light is as bright under the stroke as is usual relative to the light there.
        there = at(luminance(scene.light), index)[:, :, None, None] + 0.1
        colour = self._any(self.count)[:, :, None, None]
        glow = there * 2 ** self._uniform(self.count, 1, 1, 1, low=-1.5, high=3.0) * colour * shape
        shine = glow * srgb_to_linear(scenery.albedo)
        # Or a factor: a gel, a flag or a reflector, as far as the lamps would reach.
        factor = (2 ** self._uniform(self.count, 1, 1, 1, low=-4.0, high=2.0) * colour).clamp(
            LEAST_FACTOR, 16
        )
        times = 1 + shape.clamp(max=1) * (factor - 1)
        mode, half = blend[:, None, None, None], self._uniform(self.count, 1, 1, 1) < 0.5
        multiplies = (mode == MULTIPLY) | ((mode == SET) & half)
        relit = torch.where(multiplies, scene.photo * times, scene.photo + shine)
        target = torch.where(multiplies, scene.light * times, scene.light + glow)
        return scene.changed(is_local[:, None, None, None], relit, target), index

    # Strokes
    # ----------------------------------------------------------------------------------------------------

    def _draw(
        self,
        scenery: Scenery,
        kind: Tensor,
        blend: Tensor,
        far: Tensor,
        scene: Lit,
        brush: Brush,
        first: Tensor,
    ) -> tuple[Strokes, Lit]:
        """Return the strokes and the scene, whose change ends far from the strokes where the photo stays."""
        height, width = scenery.depth.shape[2], scenery.depth.shape[3]
        mode, light, target = blend[:, None, None, None], scene.light, scene.target
        value = torch.where(mode == ADD, (target - light).clamp_min(0), target)
        value = torch.where(mode == MULTIPLY, (target + 0.01) / (light + 0.01), value)
        start = starts(self._interest(scenery, kind, blend, scene, value), self.generator)
        is_local = kind == LOCAL
        start = torch.cat([torch.where(is_local, first, start[:, 0])[:, None], start[:, 1:]], dim=1)
        drawn, mask, points = draw(brush, value, start, scenery.ids)
        drawn, mask = self._whole_maps(kind, blend, value, drawn, mask)
        # Where the photo stays far from the strokes, the change ends at some distance in the scene.
        cells = cells_at(points, height, width).flatten(1)
        size = at(scenery.depth, start[:, 0])[:, :, None, None] * self.cell_slope * self.side
        range_ = size * self._uniform(self.count, 1, 1, 1, low=0.15, high=0.4)
        near = 1 / (1 + (nearest(scenery.position, cells) / range_) ** 4)
        whole = mask.mean(dim=(1, 2, 3)) > 0.5
        stays = ((far == 0) & ~is_local & ~whole)[:, None, None, None]
        near = torch.where(stays, torch.maximum(near, mask), torch.ones_like(near))
        relit, target = scene.photo + near * (scene.relit - scene.photo), light + near * (target - light)
        return Strokes(drawn, mask, blend, far), replace(scene, relit=relit, target=target)

    def _interest(self, scenery: Scenery, kind: Tensor, blend: Tensor, scene: Lit, value: Tensor) -> Tensor:
        """Return (B, 1, H, W), where a user would draw: where the light changes.

        Where all lights change, a user would draw in the light.
        """
        which = kind[:, None, None, None]
        change = torch.log((scene.target + 0.02) / (scene.light + 0.02)).abs().amax(dim=1, keepdim=True)
        interest = torch.where((blend == ADD)[:, None, None, None], luminance(value), change)
        everywhere = luminance(scene.target).sqrt() * (0.5 + self._uniform(self.count, 1, 1, 1)) + 0.1
        interest = torch.where(which == REPLACE, everywhere, interest) + 1e-4
        interest = torch.where(which == KEEP, torch.ones_like(interest), interest)
        return interest * (1 - scenery.sky) + 1e-6

    def _whole_maps(
        self, kind: Tensor, blend: Tensor, value: Tensor, drawn: Tensor, mask: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Give some samples the whole map, or its mean over coarse cells, some of which are missing."""
        how = self._uniform(self.count)[:, None, None, None]
        fits = ((blend == SET) & (kind != LOCAL))[:, None, None, None]
        dense = fits & (how < DENSE)
        coarse = fits & (how >= DENSE) & (how < DENSE + COARSE)
        size = (mask.shape[2], mask.shape[3])
        cells = F.interpolate(F.avg_pool2d(value, 16), size=size, mode="nearest")
        kept = (self._uniform(self.count, 1, size[0] // 16, size[1] // 16) < 0.6).float()
        kept = F.interpolate(kept, size=size, mode="nearest")
        drawn = torch.where(dense, value, torch.where(coarse, cells * kept, drawn))
        return drawn, torch.where(dense, torch.ones_like(mask), torch.where(coarse, kept, mask))


def mix(scenery: Scenery, lights: Tensor) -> tuple[Tensor, Tensor]:
    """Return picture and Lumi map (B, 3, H, W) of the sources at strength times colour (B, K, 3)."""
    weights = lights[:, :, :, None, None]
    return (scenery.images * weights).sum(dim=1), (scenery.lumi * weights).sum(dim=1)


def usual(strokes: Strokes, scene: Lit) -> tuple[Strokes, Lit]:
    """Drop the strokes of samples whose light is far beyond what people draw, or not finite.

    Nothing changes in these samples.
    """
    most = torch.stack(
        [part.flatten(1).amax(dim=1) for part in (scene.light, scene.target, scene.relit, strokes.drawn)]
    )
    fine = (most.isfinite() & (most < BRIGHTEST)).all(dim=0)[:, None, None, None]
    light = torch.where(fine, scene.light, scene.light.nan_to_num(0, 0, 0).clamp(0, 1))
    scene = replace(
        scene,
        light=light,
        relit=torch.where(fine, scene.relit, scene.photo),
        target=torch.where(fine, scene.target, light),
    )
    drawn = torch.where(fine, strokes.drawn, torch.zeros_like(strokes.drawn))
    return strokes._replace(drawn=drawn, mask=strokes.mask * fine), scene


def bright_part(picture: Tensor) -> Tensor:
    """Return (B, 1, 1, 1), the 95th percentile of the brightest channel."""
    flat = picture.amax(dim=1).flatten(1)[:, ::7]
    return torch.quantile(flat.float(), 0.95, dim=1)[:, None, None, None].clamp_min(1e-4)


def data_variable(strokes: Strokes, light: Tensor, target: Tensor) -> Tensor:
    """Return the flow's x0 of a target Lumi map, see `completion.Completed`."""
    mode = strokes.blend[:, None, None, None]
    added = (target - light).clamp_min(0) / peak(strokes.drawn, strokes.mask)
    factor = torch.log(((target + 0.01) / (light + 0.01)).clamp(LEAST_FACTOR, 64))
    code = 2 * encode_lumi(torch.where(mode == ADD, added, target)) - 1
    return torch.where(mode == MULTIPLY, FACTOR_SCALE * factor, code)


def _unit(colour: Tensor) -> Tensor:
    """Return (..., 3) colours scaled to luminance 1."""
    weights = torch.tensor([0.2126, 0.7152, 0.0722], device=colour.device)
    return colour / (colour @ weights)[..., None].clamp_min(0.05)
