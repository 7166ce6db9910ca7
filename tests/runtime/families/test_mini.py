"""Mini's encoding: the equations of the flow's data variable, and what the network gets to see."""

import dataclasses

import numpy as np
import pytest

from dior_rt.bundle import read_bundle
from dior_rt.errors import BundleError
from dior_rt.families.mini import Graphs, Mini, encode, null
from dior_rt.flow.sampler import draw_noise
from dior_rt.flow.schedule import DynamicShiftSchedule
from dior_rt.kernels import Strokes


@pytest.fixture(scope="module")
def mini(mini_bundle):
    return Mini(read_bundle(mini_bundle), "cpu")


@pytest.fixture
def photo():
    return np.random.default_rng(0).random((16, 24, 3), dtype=np.float32)


@pytest.fixture
def strokes():
    rng = np.random.default_rng(1)
    return Strokes(
        rng.random((16, 24, 3), dtype=np.float32) * 3, (rng.random((16, 24)) < 0.3).astype(np.float32)
    )


def planes(pixels):
    return pixels.transpose(2, 0, 1)[None]


def test_inputs_are_planes_in_the_photos_order(photo, strokes):
    inputs = encode(photo, strokes, "relight")
    np.testing.assert_array_equal(inputs["photo"], planes(photo))
    np.testing.assert_array_equal(inputs["mask"], strokes.mask[None, None])
    drawn = strokes.mask > 0
    np.testing.assert_array_equal(inputs["light"][0, :, drawn], strokes.light[drawn])
    assert inputs["mode"].tolist() == [0] and inputs["mode"].dtype == np.int64
    assert all(inputs[name].dtype == np.float32 for name in ("photo", "light", "mask"))


@pytest.mark.parametrize("unseen", [5.0, np.inf, np.nan])
def test_light_that_the_mask_leaves_out_is_never_seen(photo, strokes, unseen):
    light = np.where(strokes.mask[..., None] > 0, strokes.light, np.float32(unseen))
    seen = encode(photo, Strokes(light, strokes.mask), "relight")["light"]
    np.testing.assert_array_equal(seen, encode(photo, strokes, "relight")["light"])


def test_the_null_branch_is_no_strokes_at_all(photo, strokes):
    one, other = null(encode(photo, strokes, "relight")), encode(photo, None, "relight")
    assert one.keys() == other.keys()
    for name in one:
        np.testing.assert_array_equal(one[name], other[name])


def test_relit_is_decoded_as_the_photo_plus_a_quarter_of_the_state(mini, photo):
    relit = np.random.default_rng(2).random(photo.shape, dtype=np.float32)
    condition = encode(photo, None, "relight")
    np.testing.assert_allclose(mini.decode_relit(4 * planes(relit - photo), condition), relit, atol=1e-6)
    np.testing.assert_array_equal(mini.decode_relit(np.zeros_like(planes(photo)), condition), photo)
    assert mini.decode_relit(planes(photo) * 100, condition).max() == 1
    assert mini.decode_relit(planes(photo) * -100, condition).min() == 0


def test_lumi_is_decoded_by_the_inverse_of_its_encoding(mini, photo):
    lumi = np.concatenate([photo.ravel(), [0, 1e-4, 1, 50]]).reshape(-1, 1, 1).repeat(3, 2).astype(np.float64)
    x0 = planes(2 * np.log1p(8 * lumi) / np.log(9) - 1).astype(np.float32)
    decoded = mini.decode_lumi(x0, encode(photo, None, "estimate"))
    np.testing.assert_allclose(decoded, lumi, rtol=1e-5, atol=1e-6)
    assert mini.decode_lumi(np.full_like(x0, -7), {}).max() == 0


def test_velocity_is_guided_between_the_two_branches(mini, photo, strokes):
    condition, x = encode(photo, strokes, "relight"), draw_noise(0, (1, 3, 16, 24))
    sigmas = mini.sigmas(4, condition)
    v_null, v_cond, v = (mini.velocity(condition, sigmas, scale)(x, 0.7) for scale in (0.0, 1.0, 3.0))
    assert np.abs(v_cond - v_null).max() > 1e-3
    np.testing.assert_allclose(v, v_null + 3 * (v_cond - v_null), rtol=1e-4, atol=1e-4)


class Counted:
    """An engine that counts its runs."""

    def __init__(self, engine):
        self.engine, self.runs = engine, 0

    def run(self, feeds):
        self.runs += 1
        return self.engine.run(feeds)

    def bind(self, constants):
        return self.engine.bind(constants)


def test_what_a_photo_says_is_asked_once_while_someone_paints_on_it(mini, photo, strokes):
    graphs = Graphs(Counted(mini._graphs.encode), Counted(mini._graphs.velocity))
    other, more = photo[:, ::-1], Strokes(2 * strokes.light, strokes.mask)
    conditions = [encode(*each, "relight") for each in ((photo, strokes), (photo, more), (other, more))]
    found = [graphs.branches(condition) for condition in (*conditions, conditions[0])]
    # The photo alone and its light, for each of three changes of photo; and the strokes, each time.
    assert (graphs.encode.runs, graphs.velocity.runs) == (3 + 4, 3)
    for condition, branches in zip((*conditions, conditions[0]), found, strict=True):
        afresh = Graphs(mini._graphs.encode, mini._graphs.velocity).branches(condition)
        for branch, expected in zip(branches, afresh, strict=True):
            for name, array in expected.items():
                np.testing.assert_array_equal(branch[name], array)


def test_an_estimate_asks_for_no_light_beforehand(mini, photo):
    graphs = Graphs(Counted(mini._graphs.encode), Counted(mini._graphs.velocity))
    drawn, blank = graphs.branches(encode(photo, None, "estimate"))
    assert drawn.keys() == blank.keys() and (graphs.encode.runs, graphs.velocity.runs) == (1, 0)


def test_the_graph_sees_strokes_and_mode(mini, photo, strokes):
    x = draw_noise(0, (1, 3, 16, 24))
    seen = [
        mini.velocity(condition, mini.sigmas(4, condition), 1.0)(x, 0.7)
        for condition in (
            encode(photo, strokes, "relight"),
            encode(photo, None, "relight"),
            encode(photo, strokes, "estimate"),
            encode(1 - photo, strokes, "relight"),
        )
    ]
    for i, one in enumerate(seen):
        for other in seen[:i]:
            assert np.abs(one - other).max() > 1e-3


@pytest.mark.parametrize(
    "change",
    [{"grid": None}, {"family": "qwen"}, {"schedule": DynamicShiftSchedule(0.5, 0.9, 256, 8192, 0.02)}],
)
def test_a_bundle_that_is_no_complete_mini_is_refused(mini_bundle, change):
    bundle = read_bundle(mini_bundle)
    with pytest.raises(BundleError, match="no complete bundle"):
        Mini(dataclasses.replace(bundle, manifest=dataclasses.replace(bundle.manifest, **change)))
