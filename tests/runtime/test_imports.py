"""The runtime never needs what training and export need."""

import subprocess
import sys

WALK = """
import importlib, pkgutil, sys
import dior_rt, dior_rt.kernels

OTHERS = ("dior_rt.export", "dior_rt.training", "dior_rt.__main__", "dior_rt.batch.ray_engine")
for package in (dior_rt, dior_rt.kernels):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not module.name.startswith(OTHERS):
            importlib.import_module(module.name)
assert {"dior_rt.cli.app", "dior_rt.families.mini", "dior_rt.kernels.opencl_ops"} <= sys.modules.keys()
dior_rt.Relighter
extras = "torch onnx onnxscript safetensors peft accelerate mitsuba diffusers transformers".split()
print(*(name for name in extras if name in sys.modules))
"""


def test_importing_every_runtime_module_loads_none_of_the_extras():
    result = subprocess.run([sys.executable, "-c", WALK], capture_output=True, text=True, check=True)
    assert result.stdout.split() == []


def test_importing_the_package_alone_does_not_load_onnxruntime():
    check = "import sys, dior_rt, dior_rt.kernels; print('onnxruntime' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"
