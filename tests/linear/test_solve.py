"""Steps towards light that is never negative, against the formulas with a small dense matrix, and where they stop."""

import numpy as np
import pytest

from mitsuba_plenoptic.linear.map import LinearMap
from mitsuba_plenoptic.linear.noise import PixelNoise, misfit
from mitsuba_plenoptic.linear.solver import RichardsonLucy, SolverState, relative_residual, solve


class Blur(LinearMap):
    """A small map that is known: neighbours share their light."""

    def __init__(self):
        super().__init__((20,), (20,))
        bins = np.arange(20)
        self.matrix = np.exp(-(((bins[:, None] - bins) / 1.5) ** 2)).astype(np.float32)

    def forward(self, values):
        return self.matrix @ values

    def adjoint(self, image):
        return self.matrix.T @ image


BLUR = Blur()


def likelihood(values, image):
    model = BLUR.forward(values)
    return float((image * np.log(model) - model).sum())


def test_iteration_is_richardsons_and_lucys_and_the_accelerated_one_goes_on_faster():
    truth = np.zeros(20, np.float32)
    truth[[6, 11, 12]] = 1, 2, 1
    image = BLUR.forward(truth)
    expected = np.full(20, image.sum() / BLUR.matrix.sum(), np.float64)
    for _ in range(8):
        expected *= BLUR.matrix.T @ (image / (BLUR.matrix @ expected)) / BLUR.matrix.sum(0)
    steps = RichardsonLucy(BLUR, image)
    plain = solve(steps, iterations=8)
    assert plain.iterations == 8
    np.testing.assert_allclose(plain.values, expected, rtol=0.01, atol=1e-3)
    # Light is kept, and never negative.
    assert (plain.values >= 0).all()
    assert plain.model.sum() == pytest.approx(image.sum(), rel=1e-3)
    many, quick = solve(steps, iterations=120), solve(steps, iterations=30, accelerate=True)
    assert relative_residual(image, plain.model) > relative_residual(image, many.model)
    assert likelihood(quick.values, image) >= likelihood(many.values, image)


@pytest.mark.parametrize("accelerate", [False, True])
def test_an_iteration_goes_on_from_its_saved_state_with_the_same_bits(accelerate):
    image, states = BLUR.forward(np.linspace(0, 3, 20, dtype=np.float32)), []
    steps = RichardsonLucy(BLUR, image)
    whole = solve(steps, iterations=9, accelerate=accelerate, save=lambda state: states.append(state.arrays()))
    again = solve(steps, iterations=9, accelerate=accelerate, state=SolverState.of(states[4], (20,)))
    np.testing.assert_array_equal(again.point, whole.point)
    assert again.iterations == 9


def test_dim_areas_stay_as_bright_as_they_are():
    """Momentum carried bins of a tenth of the mean to 0 in its first step, where products leave them."""
    truth = np.where(np.arange(20) < 10, 0.05, 1).astype(np.float32)
    for iterations in (30, 100):
        found = solve(RichardsonLucy(BLUR, BLUR.forward(truth)), iterations=iterations, accelerate=True).point
        np.testing.assert_allclose(found[:7], 0.05, atol=0.025)
        assert found[:10].mean() == pytest.approx(0.05, abs=0.01)


class Lobes(Blur):
    """A response with negative lobes, as interpolation leaves them, of a blur without any."""

    def __init__(self):
        LinearMap.__init__(self, (400,), (400,))
        away = np.abs(np.subtract.outer(np.arange(400), np.arange(400)))
        self.blur = np.exp(-((away / 1.5) ** 2))
        self.matrix = (self.blur - 1e-3 * np.exp(-(((away - 6) / 1.5) ** 2))).astype(np.float32)


@pytest.mark.parametrize("iterations", [10, 31, 32])
def test_lamps_in_the_dark_keep_their_light_with_a_response_that_is_a_thousandth_off(iterations):
    """Ratios of what is dark to less than no light made accelerated steps swing between a half and more than all."""
    operator = Lobes()
    truth = np.zeros(400)
    truth[[100, 200, 203]] = 1, 2, 1
    steps = RichardsonLucy(operator, (operator.blur @ truth + 1e-3).astype(np.float32))
    assert solve(steps, iterations=iterations, accelerate=True).point[97:104].sum() == pytest.approx(1, abs=0.005)


@pytest.mark.needs_extension("deconvolution")
def test_iteration_stops_at_the_noise():
    from mitsuba_plenoptic.extensions.deconvolution.deconvolved import until_noise

    truth = np.linspace(1, 2, 20).astype(np.float32)
    truth[8] = 8
    image, noise = np.random.default_rng(3).poisson(BLUR.forward(truth) * 100).astype(np.float32), PixelNoise(1.0)
    options = {"iterations": 500, "accelerate": True}
    found = solve(RichardsonLucy(BLUR, image), stop=until_noise(noise), **options)
    assert found.stopped == "noise"
    assert 0 < found.iterations < 500
    further = solve(RichardsonLucy(BLUR, image), **options)
    assert not further.stopped
    assert relative_residual(image, further.model) < relative_residual(image, found.model)
    assert misfit(noise, image, BLUR.forward(found.point)) <= 1 < misfit(noise, image, BLUR.forward(truth * 50))
    # Light that the bins cannot make does not keep it going.
    image[::2] *= 3
    assert solve(RichardsonLucy(BLUR, image), stop=until_noise(noise), **options).iterations < 100
