"""Which device is opened, why, and what happens where one is missing or computes wrongly."""

import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from dior_rt.kernels import (
    KernelError,
    NumpyOps,
    OpenCLOps,
    Strokes,
    check_device,
    list_devices,
    open_ops,
    self_test,
)

REPORT = "from dior_rt.kernels import open_ops; ops = open_ops('auto'); print(ops.name, '|', ops.reason)"


def run(code, **environment):
    """Standard output of a fresh interpreter; a value of None removes the variable."""
    merged = {key: value for key, value in (os.environ | environment).items() if value is not None}
    return subprocess.run(
        [sys.executable, "-c", code], env=merged, capture_output=True, text=True, check=True
    ).stdout.strip()


def list_devices_or_none():
    try:
        return list_devices()
    except KernelError:
        return []


def _works(device):
    try:
        check_device(device)
    except KernelError:
        return False
    return True


#: A driver may have a device that it cannot compile for, such as PoCL of 2022 for a CPU of 2025.
WORKING = [device for device in list_devices_or_none() if _works(device)]


class Wrong(NumpyOps):
    """A device with one fault."""

    name = "wrong"


class SlightlyOff(Wrong):
    def _encode(self, linear, dtype):
        code = super()._encode(linear, dtype)
        return code + (code == 100).astype(dtype)


class Nan(Wrong):
    def _reduce_photo(self, picture, grid):
        mean = super()._reduce_photo(picture, grid)
        mean[-1, -1] = np.nan
        return mean


class OtherMask(Wrong):
    def _cut(self, lumi, discs):
        strokes = super()._cut(lumi, discs)
        return Strokes(strokes.light, np.roll(strokes.mask, 1, 1))


class OtherKind(Wrong):
    def _decode(self, picture):
        return super()._decode(picture).astype(np.float64)


class Broken(Wrong):
    def _draw_strokes(self, strokes, size):
        raise RuntimeError("the driver gave up\nwith much to say")


@pytest.mark.parametrize(
    ("device", "says"),
    [
        (
            SlightlyOff,
            "wrong failed its self-test of encode_srgb to uint8: it is off by 1 where 0 is allowed",
        ),
        (Nan, "wrong failed its self-test of reduce_photo of uint8: it is off by nan where 1e-05 is allowed"),
        (OtherMask, "wrong failed its self-test of sparsify to strokes: it is off by 1 where 0 is allowed"),
        (
            OtherKind,
            "wrong failed its self-test of decode_srgb of uint8: another shape or dtype",
        ),
        (Broken, "wrong failed its self-test of draw_strokes (the driver gave up)"),
    ],
)
def test_a_device_that_computes_wrongly_is_found_out(device, says):
    with pytest.raises(KernelError, match=f"^{re.escape(says)}$"):
        self_test(device())


def test_every_device_here_passes_with_every_dtype(ops):
    self_test(ops, (np.uint8, np.uint16, np.float32))


def test_devices_are_opened_by_number_and_by_name():
    for device in WORKING:
        assert open_ops(f"opencl:{device.index}").name.startswith(f"opencl:{device.index} ")
        by_name = next(other for other in list_devices() if device.name[:30].lower() in other.name.lower())
        if by_name in WORKING:
            assert device.name in open_ops(f"opencl:{device.name[:30].upper()}").name


PROBE = """
import os, sys
from pathlib import Path
from dior_rt.kernels import list_devices, open_ops, probe
calls = []
def crash(device):
    calls.append(list(Path(os.environ["POCL_CACHE_DIR"]).iterdir()))
    return -6
probe._try_elsewhere = crash
ops = open_ops("auto")
print(len(calls), [len(seen) for seen in calls], ops.name, "|", ops.notice)
"""


@pytest.mark.skipif(not WORKING, reason="no OpenCL device works here")
def test_a_driver_that_crashes_means_numpy_a_notice_and_an_empty_cache(tmp_path):
    (tmp_path / "dior-rt" / "pocl").mkdir(parents=True)
    (tmp_path / "dior-rt" / "pocl" / "truncated").write_bytes(b"half")
    said = run(PROBE, XDG_CACHE_HOME=str(tmp_path), POCL_CACHE_DIR=None)
    found = re.match(r"(\d+) \[(\d+), (\d+)", said)
    assert found and int(found[1]) >= 2 and int(found[2]) >= 1 and found[3] == "0"
    assert "] numpy | The pixel kernels run on NumPy" in said
    assert "signal 6" in said


@pytest.mark.skipif(not WORKING or not hasattr(os, "fork"), reason="no OpenCL device works here")
def test_a_file_size_limit_is_seen_before_the_driver_meets_it(tmp_path):
    code = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n" + REPORT
    assert re.match(r"numpy \| .*64 MB.*so the pixel kernels run on NumPy", run(code, POCL_CACHE_DIR=None))


def test_a_device_with_memory_of_its_own_passes_too(opencl):
    """The launch on a GPU: copies, a work item per cell or pixel, groups of the driver's choice, one lane."""
    ops = OpenCLOps(list_devices()[int(opencl.name.split()[0].removeprefix("opencl:"))])
    ops._session._shares_memory, ops._session._run, ops._session.lanes = False, 1, 1
    self_test(ops)


def test_what_a_driver_reports_is_one_sentence(opencl):
    with pytest.raises(KernelError, match=r"^the OpenCL device failed \(.*\)$"):
        opencl._session.scratch(1 << 62)


def test_auto_prefers_opencl_and_says_why():
    ops = open_ops("auto")
    if WORKING:
        assert ops.name.startswith("opencl:") and "self-test" in ops.reason
    else:
        assert ops.name == "numpy" and "NumPy" in ops.reason


def test_numpy_is_there_when_asked_for():
    assert open_ops("numpy").name == "numpy"


@pytest.mark.parametrize("name", ["opencl:99", "opencl:no such device", "cuda", ""])
def test_what_is_named_and_absent_is_an_error(name):
    with pytest.raises(KernelError):
        open_ops(name)


def test_without_a_platform_auto_is_numpy_and_says_so():
    assert re.fullmatch(
        r"numpy \| there is no OpenCL platform \(.+\); so the pixel kernels run on NumPy",
        run(REPORT, OCL_ICD_VENDORS="/nonexistent", OPENCL_LAYERS=None),
    )


def test_without_a_platform_opencl_is_an_error():
    code = (
        "from dior_rt.kernels import KernelError, open_ops\n"
        "try: open_ops('opencl')\nexcept KernelError as error: print(error)"
    )
    assert run(code, OCL_ICD_VENDORS="/nonexistent").startswith("there is no OpenCL platform")


@pytest.mark.parametrize("home", ["/proc/none", None])
def test_opencl_needs_no_home(home):
    """PoCL compiles to a folder, and would have no device, or use /tmp/pocl, without one."""
    code = REPORT + "; import os; print(os.environ['POCL_CACHE_DIR'])"
    report, folder = run(code, HOME=home, XDG_CACHE_HOME=None, POCL_CACHE_DIR=None).splitlines()
    assert report.partition(" ")[0].partition(":")[0] == open_ops("auto").name.partition(":")[0]
    assert "no OpenCL platform has a device" not in report or not list_devices_or_none()
    assert folder != "/tmp/pocl/kcache" and (home is None or not Path(folder).exists())


def test_importing_the_kernels_leaves_pyopencl_alone():
    assert run("import dior_rt.kernels, sys; print('pyopencl' in sys.modules)") == "False"


def test_threads_may_share_a_device(ops):
    rng = np.random.default_rng(0)
    photos = [rng.integers(0, 256, (97, 101 + k, 3), dtype=np.uint8) for k in range(8)]
    source, relit = rng.random((2, 9, 12, 3), np.float32)

    def work(photo):
        return ops.reduce_photo(photo, (9, 12)), ops.transfer(photo, source, relit)

    alone = [work(photo) for photo in photos]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(work, photos * 3))
    for (grid, picture), (expected_grid, expected) in zip(together, alone * 3, strict=True):
        np.testing.assert_array_equal(grid, expected_grid)
        np.testing.assert_array_equal(picture, expected)
