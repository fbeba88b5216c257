"""The chain of a field's factors: its derivatives against differences of the intensity, and against each other."""

import numpy as np
import pytest

from mitsuba_plenoptic.points.patch import FieldChain, Memory

DIRECTIONS, SAMPLES, ON_ARRAY = 7, 16, 20
AXES = {"separable": [(0,), (1,)], "plane": [(0,), (1,), (0, 1)]}
chains = pytest.mark.parametrize("axes", AXES.values(), ids=AXES)


def random_parts(axes, seed):
    rng = np.random.default_rng(seed)
    shapes = [(DIRECTIONS,) * 2, *((ON_ARRAY,) * len(own) for own in axes), (SAMPLES,) * 2]
    return [(rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64) for shape in shapes]


def chain_of(parts, axes, finer):
    return FieldChain([part[None] for part in parts], axes, finer, Memory(), parts[-1].conj()[None])


def stacked_conj(parts):
    """Return the conjugates of the transfer functions of several points."""
    return np.stack([own[-1].conj() for own in parts])


@chains
def test_a_field_is_the_plain_transform_of_its_factors(axes):
    pupil, along_x, along_y, *plane, transfer = parts = random_parts(axes, 0)
    wide = np.zeros((ON_ARRAY,) * 2, complex)
    wide[:DIRECTIONS, :DIRECTIONS] = pupil
    on_array = np.fft.ifft2(wide, norm="forward") * along_x * along_y[:, None]
    spectrum = np.fft.fft2(on_array * plane[0] if plane else on_array)[:SAMPLES, :SAMPLES]
    expected = np.fft.ifft2(spectrum * transfer, norm="forward")
    assert np.linalg.norm(chain_of(parts, axes, 1).field - expected) < 1e-6 * np.linalg.norm(expected)


@chains
@pytest.mark.parametrize("finer", [1, 2])
def test_several_points_pass_a_chain_like_each_alone(axes, finer):
    """Their fields, changes and cotangents; the products with changes are summed."""
    parts, changes = ([random_parts(axes, seed + point) for point in range(3)] for seed in (20, 30))
    chain = FieldChain([np.stack(own) for own in zip(*parts, strict=True)], axes, finer, Memory(), stacked_conj(parts))
    together = [np.stack(own) for own in zip(*changes, strict=True)]
    gradient = np.random.default_rng(9).normal(size=chain.field.shape).astype(np.float32)
    moved, change = chain.spectrum_jvp([*together[:-1], None]), chain.jvp(together)
    (product,), cotangents = chain.products(gradient, [moved]), chain.vjp(gradient, [True] * len(together))
    alone, total = [chain_of(own, axes, finer) for own in parts], 0.0
    for point, (one, own) in enumerate(zip(alone, changes, strict=True)):
        np.testing.assert_allclose(change[point], one.jvp(own)[0], rtol=1e-4, atol=1e-5 * np.abs(change).max())
        total += one.products(gradient[point : point + 1], [one.spectrum_jvp([*own[:-1], None])])[0]
        found = one.vjp(gradient[point : point + 1], [True] * len(own))
        for ours, theirs in zip(cotangents, found, strict=True):
            np.testing.assert_allclose(ours[point], theirs[0], rtol=1e-4, atol=1e-5 * np.abs(ours).max())
    assert product == pytest.approx(total, rel=1e-4)


@chains
@pytest.mark.parametrize("finer", [1, 2])
def test_jvp_against_differences(axes, finer):
    parts, changes, step = random_parts(axes, 1), random_parts(axes, 2), 3e-3
    for chosen in (range(len(parts)), *([which] for which in range(len(parts)))):
        some = [change if which in chosen else None for which, change in enumerate(changes)]
        high, low = (
            chain_of(
                [
                    part if change is None else part + side * step * change
                    for part, change in zip(parts, some, strict=True)
                ],
                axes,
                finer,
            ).intensity.astype(np.float64)
            for side in (1, -1)
        )
        found = chain_of(parts, axes, finer).jvp(some)
        assert np.linalg.norm(found - (high - low) / (2 * step)) < 1e-3 * np.linalg.norm(found), chosen


@chains
@pytest.mark.parametrize("finer", [1, 2])
def test_vjp_is_the_transpose_of_jvp(axes, finer):
    parts, changes = random_parts(axes, 3), random_parts(axes, 4)
    chain = chain_of(parts, axes, finer)
    gradient = np.random.default_rng(5).normal(size=chain.field.shape).astype(np.float32)
    expected = np.vdot(gradient.astype(np.float64), chain.jvp(changes))
    cotangents = chain.vjp(2 * gradient, [True] * len(parts))
    found = sum(
        np.vdot(part.reshape(change.shape), change).real for part, change in zip(cotangents, changes, strict=True)
    )
    assert found == pytest.approx(expected, rel=1e-4)
    wanted = [which % 2 == 0 for which in range(len(parts))]
    some = chain_of(parts, axes, finer).vjp(2 * gradient, wanted)
    assert [part is not None for part in some] == wanted


@chains
def test_changes_of_the_spectrum_lead_to_those_of_the_intensity(axes):
    parts, changes = random_parts(axes, 6), [*random_parts(axes, 7)[:-1], None]
    chain = chain_of(parts, axes, 2)
    change = chain.spectrum_jvp(changes)
    assert np.allclose(chain.jvp_of_spectrum(change), chain.jvp(changes), rtol=1e-4, atol=1e-2)
    gradient = np.random.default_rng(8).normal(size=chain.field.shape).astype(np.float32)
    (product,) = chain.products(2 * gradient, [change])
    assert product == pytest.approx(np.vdot(gradient.astype(np.float64), chain.jvp_of_spectrum(change)), rel=1e-4)
