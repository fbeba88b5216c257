"""Focusing by a group of elements: traced rays meet the axis at the distance that shall be in focus."""

import math

import pytest
from refusals import refuses

from mitsuba_plenoptic import LensSystem, PlenopticCamera, focus_by_group
from mitsuba_plenoptic.prescription import paraxial


def of(name, **numbers):
    return PlenopticCamera(main_lens=name, **({"focus_distance": math.inf} | numbers))


def from_first_vertex(camera):
    numbers = paraxial(camera.main_lens)
    scale = camera.focal_length / numbers.focal_length
    return scale * (numbers.length + numbers.rear_principal) + camera.mla_distance


@pytest.mark.parametrize(
    ("name", "group"), [("cooke_triplet", (1, 2)), ("cooke_triplet", (3, 6)), ("tessar", (1, 2)), ("tessar", (3, 4))]
)
def test_rays_near_the_axis_meet_where_it_is_in_focus(name, group):
    camera, distance = of(name, focal_length=80, aperture_radius=4), 3000.0
    found = focus_by_group(camera, group, distance)
    point, towards, is_open = LensSystem.of(found).trace((0.0, 0.0), (1e-5, 0.0))
    assert is_open
    assert point[2] - point[0] / towards[0] == pytest.approx(distance, rel=1e-6)
    # The array stays, before the surfaces that stay.
    assert (abs(from_first_vertex(found) - from_first_vertex(camera)) > 1e-3) == (group[0] == 1)
    before, after = camera.main_lens.surfaces, found.main_lens.surfaces
    kept = [number for number in range(len(before) - 1) if number not in (group[0] - 2, group[1] - 1)]
    assert all(before[number].thickness == after[number].thickness for number in kept)
    assert any(a.thickness != b.thickness for a, b in zip(before, after, strict=True))
    # The stop's opening stays, over that of the prescription.
    open_before, open_after = (
        each.aperture_radius * paraxial(each.main_lens).focal_length / each.focal_length
        / paraxial(each.main_lens).entrance_radius
        for each in (camera, found)
    )  # fmt: skip
    assert open_after == pytest.approx(open_before, rel=1e-9)
    assert PlenopticCamera.from_json(found.to_json()) == found


@pytest.mark.parametrize(("front", "rear", "gap", "near"), [(-71, 49, 40, 36.46), (-54, 37, 13, 16.36)])
def test_the_nearest_of_two_positions_is_taken(front, rear, gap, near):
    """A hollow lens before a converging one images the same plane onto the array from two; 21.77 and 26.01 are far."""

    def pair(gap):
        lens = {"thickness": 0.5, "glass": 1.5, "semi_aperture": 3}
        behind = {"semi_aperture": 3}
        return [
            {**lens, "radius": front, "stop": True}, {**behind, "radius": -front, "thickness": gap},
            {**lens, "radius": rear}, {**behind, "radius": -rear},
        ]  # fmt: skip

    camera = of({"surfaces": pair(gap)})
    assert focus_by_group(camera, (3, 4), 3000).main_lens.surfaces[1].thickness == pytest.approx(near, abs=0.01)


def test_groups_that_are_none_are_refused():
    camera = of("cooke_triplet")
    refuses(r"group = \(1, 6\)", focus_by_group, camera, (1, 6), 1000.0)
    refuses(r"group = \(2, 3\): .*surface 1", focus_by_group, camera, (2, 3), 1000.0)
    refuses("group", focus_by_group, camera, (4, 3), 1000.0)
    refuses("group = 3", focus_by_group, camera, 3, 1000.0)
    refuses("group = 7", focus_by_group, camera, (1, 7), 1000.0)
    refuses("distance = 51", focus_by_group, camera, (1, 2), 51.0)
    refuses("main_lens", focus_by_group, PlenopticCamera(), (1, 2), 1000.0)


def test_a_group_must_not_run_into_its_neighbours():
    """The hollow rear of the first lens reaches 1.27 mm over its vertex at its edge, the second's front 0.50 mm."""
    front = {"radius": 30, "thickness": 5, "glass": 1.6, "semi_aperture": 10, "stop": True}
    rear = {"radius": 100, "thickness": 4, "glass": 1.6, "semi_aperture": 10}
    hollow = {"radius": 40, "thickness": 6, "semi_aperture": 10}
    camera = of({"surfaces": [front, hollow, rear, {"radius": -100, "semi_aperture": 10}]})
    assert focus_by_group(camera, (3, 4), 1000).main_lens.surfaces[1].thickness > 0.77
    refuses("main_lens: surfaces 2 and 3 cross", focus_by_group, camera, (3, 4), 760)
