"""Numbers that settle how exactly real main lenses are traced and fitted, and how many rays that takes."""

from dataclasses import dataclass


@dataclass(frozen=True)
class LensAccuracy:
    """Counts, steps and limits; each costs time where it is made finer."""

    # The exit pupil of a prescription, as the array sees it
    tested_fields: int = 9  # positions on the array that are tested for light
    tested_points: int = 181  # points across the exit pupil that are tested for light
    tested_radius: float = 3.0  # largest radius that is tested, over that of the paraxial exit pupil
    secants: int = 8  # secant iterations that find a chief ray
    few_secants: int = 3  # iterations at the steps before it
    height_steps: int = 4  # steps of the height from the axis by which a chief ray is approached

    # Rays through aspheres
    # Newton iterations that find the intersection with an asphere from that with its conic or plane.
    newton_steps: int = 5
    # Length of the last iteration, over the semi-aperture, from which on a ray counts as one that misses.
    missing: float = 1e-3

    # Thin lenses
    # Nodes of the quadrature over the pupil, along its radius and around half of its circumference.
    wavefront_nodes: int = 24
    distortion_steps: int = 12  # iterations that find the position on the array from the undistorted one

    # Rays through real lenses
    edge_fields: int = 17  # distances from the axis at which the edge of the pupil is searched
    edge_angles: int = 256  # directions in which the edge is searched
    edge_directions: int = 4096  # directions to which the edge is interpolated
    map_nodes: int = 97  # nodes across the pupil of the map from the exit pupil
    map_extent: float = 1.1  # extent of the map over that of the pupil and of the detector's corner
    edge_bisections: int = 24  # bisections that find an edge
    centre_rays: int = 65  # rays across the pupil that find its centre
    field_step: float = 1.1  # factor of the steps of the fitted fields, so that fits are reused
    depth_step: float = 0.02  # step of the fitted inverse distances, over the lens's power, for the same reason
    narrowest_field: float = 0.1  # smallest range of fields that is fitted, over that of the detector
    # Field that `farthest` covers, over that of the detector's corner, because of distortion and blur.
    farthest_field: float = 1.1
    open_fields: int = 17  # distances from the axis at which the open part of the pupil is computed
    open_rays: int = 151  # rays across the pupil by which it is computed
    # Largest of these distances, over that of the detector's corner: lenses farther out contribute light, too.
    open_reach: float = 1.05

    # Polynomials that are fitted to the light on the exit pupil
    ray_height: float = 1.1  # largest accepted ray height, over the semi-aperture of each surface
    # Distance of neighbouring rays over the pupil's radius, from which the density of rays is computed.
    ray_step: float = 1e-4
    steepest: float = 10.0  # largest accepted slope of rays behind the lens
    # Polynomial degrees that are tried in turn.
    degrees: tuple[tuple[int, int, int], ...] = ((6, 4, 4), (8, 6, 4), (10, 8, 5))
    path_error: float = 1e-3  # root mean square path error in waves that ends the search
    # Degrees of the polynomials of vignetting surfaces: low ones, which extrapolate smoothly.
    stop_degrees: tuple[int, int, int] = (4, 4, 2)
    fitted_rays: int = 21  # rays across the entrance pupil
    fitted_radius: float = 1.4  # radius up to which they are traced, in radii of the pupil
    fitted_fields: int = 11  # points along the field whose rays are fitted
    fitted_depths: int = 7  # points along the inverse distance whose rays are fitted
    checked_points: int = 40  # points that check a fit
    checking_rays: int = 300  # rays traced from each of them
    least_open_rays: int = 20  # fewest open rays with which such a point counts
    covered_fields: int = 64  # fields, up to the largest one, that are tested for light
    single_degree: int = 10  # degree of the polynomials of a single point
    single_rays: int = 45  # rays across the pupil for it; alternate ones are fitted, others check

    # Fitted lenses of many points
    # Fraction of the fitted field that is used, so that rounding does not place points beyond it.
    used_field: float = 0.999
    # Iterations that find scene points from images; each multiplies the error by about the relative distortion.
    inversions: int = 12
    compared_fields: int = 33  # fields at which wavefronts are compared
    compared_angles: int = 16  # angles on the pupil at which they are compared
    compared_radii: int = 8  # radii on the pupil at which they are compared
    # Largest of these radii over the pupil's, since points on the very edge may count as outside.
    compared_rim: float = 0.999
    # Weight of changes of the path. The bounds for sharing patterns were chosen with the thin lens's closed form,
    # which exceeds its path by this factor.
    path_weight: float = 2.0
    # Distance from an edge, over the pupil's radius, up to which positions sample the motion of the edge.
    edge_distance: float = 0.15
    # Change of a wavefront, in waves, that counts as much as an edge shift of one wave's tilt across a lens.
    edge_weight: float = 1 / 4
    stretch_fields: int = 257  # distances from the axis at which the stretch of images is computed
    area_samples: int = 192  # samples across the pupil's bounding circle for its open area
    area_edge: float = 4.0  # width of softened edges in these samples
    area_fields: int = 17  # fields of the table from which the open areas of many points are interpolated
    area_depths: int = 3  # inverse distances of this table
    derivative_step: float = 1e-4  # relative change of a parameter on either side


ACCURACY = LensAccuracy()
"""The numbers in use."""
