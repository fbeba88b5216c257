"""Numbers that settle how exactly waves are described: those of usual plans, and the few that finer plans change."""

from dataclasses import dataclass

DEFAULT_ACCURACY = 0.01
"""Default allowed relative error, L2 over the image."""


@dataclass(frozen=True)
class WaveAccuracy:
    """Counts, steps and limits; each costs time or memory where it is made finer."""

    # Wigner functions of the pupil, and the plans of a wavelength
    degree: int = 4  # degree that gives the number of functions over a lens
    window: int = 9  # units across the window at the pupil's rim
    radial: int = 14  # nodes of the table along the pupil's radius
    tolerance: float = 0.005  # part of images of random light that kernels may lack, but for the factors below
    high_defocus: float = 4.0  # defocus of the microlenses in radians beyond which the degree is increased by two
    # Cells of the grid per period of the highest frequency of a microlens's diffraction. Two resolve it; 4 also
    # resolve the interference of neighbouring lenses.
    cells: float = 2.0
    most_cells: int = 2  # most cells of the grid across a pixel, as a pixel integrates over what more resolve
    # Width of pixels, in widths of a lens's diffraction, from which finer plans' cells hold for all, as kernels on
    # fewer cells would have too few lags.
    coarse_pixel: float = 16.0
    # Least unit of windows over lambda b / R, where it is not a lens: nine contain 99.4 % of the Airy pattern.
    airy_unit: float = 3.8
    # Width of the window around a lens over the width of the pupil's diffraction along the radius, lambda b / 2 h.
    window_spreads: float = 2.0
    least_window: int = 3  # units across the smallest window
    narrow_spread: float = 0.2  # spread in units below which the smallest window is one unit smaller
    oversampling: float = 1.4  # samples of the table over those that its highest frequency requires
    most_samples: int = 32  # largest number of these samples per lens
    # Units of windows, over the pitch, beyond which samples are twice as dense: linear interpolation of the slopes of
    # the pupil's pattern between fewer samples is up to 7 % too high at lens centres.
    wide_unit: float = 5.0
    most_shift: float = 0.3  # largest displacement in pixels by the pupil's diffraction beyond `most_phase`
    # Width of openings in wavelengths below which kernels lack more than 3 % of the light, or have far too much.
    narrowest_opening: float = 10.0
    # Points of the Fibonacci lattice by which overlaps around a table node are averaged, and its step.
    overlap_points: tuple[int, int] = (89, 55)
    least_transmission: float = 0.01  # of an apodised pupil in its overlaps, which are divided by it

    # Fields behind single lenses
    # Least square of the cosine of an angle of incidence; more grazing light, from far neighbours, is left out.
    grazing: float = 1e-3
    # Largest defocus in radians at a lens's edge for which functions over the lens describe where rays land.
    most_phase: float = 8.0

    # Functions over a lens, and their kernels
    function_samples: int = 192  # samples across a lens for the Fourier coefficients of its functions
    spectrum_samples: int = 256  # the same for polynomials where rays land by their own points
    higher_degrees: int = 4  # combined degrees above that whose polynomials are as many as the functions
    coarse_points: int = 48  # points across an aperture for which functions and oblique kernels are the best
    coarse_lags: int = 16  # lags on either side, at most, for which they are the best
    # Samples across an aperture for the changes of kernels with the direction of light; other kernels have twice
    # `pitch_lags` across the pitch.
    coarse_samples: int = 96
    missing_functions: float = 0.75  # part that may be missing for want of functions, over the tolerance
    # Lags per pitch of lenses' transfer functions; the phases of twice as many points differ by a tenth of a period.
    pitch_lags: int = 64
    cycle_samples: float = 2.0  # samples per cycle of a lens's highest frequency; two represent it completely
    missing_oblique: tuple[float, float] = (2.0, 1.25)  # for want of oblique kernels; of steep light
    most_oblique: int = 2  # oblique kernels for a function: more are only needed for lenses faster than f/2
    oblique_coarser: int = 4  # ratio of the lags of oblique kernels of degree 2, which are small changes
    # Largest direction cosine in front of a lens, plus that by which its edge refracts, from where on kernels change
    # with the direction as polynomials of degree 4.
    steep: float = 0.3
    oblique_fields: int = 9  # positions across the detector whose rays the oblique kernels are for
    oblique_pupil: int = 9  # positions across the pupil whose rays they are for
    mirrored: float = 1e-5  # difference from the mirror image, of largest values 1, of what is symmetric
    border: int = 8  # samples over which kernels fall to zero at the ends of periods that are no whole samples
    derivative_samples: int = 16  # samples on either side in the derivative filter
    derivative_shape: float = 8.0  # shape parameter of its Kaiser window

    # Functions of the smallest error
    # Relative difference of the errors that two functions remove which a lens's symmetry explains: both are used.
    tied: float = 1e-3
    worst_condition: float = 1e5  # of the polynomials' coefficients, which rays evaluate in single precision

    # Changes of kernels with the direction of light
    added_variance: float = 1e-9  # part of the mean variance that is added, so that matrices can be inverted
    inner_ring: float = 0.55  # radius, in largest cosines, of the inner directions that tell terms of degree 4

    # Kernels of pixels
    sharpened: int = 8  # samples by which kernels grow when they undo the smoothing of collected rays
    missing_products: float = 0.7  # part that may be missing for want of products of terms and coefficients
    alike_cells: float = 0.5  # correlation of light between the cells of a pixel, which mostly see the same

    # The pupil without an array
    pupil_samples: int = 256  # samples of the transmission across the pupil
    sample_points: int = 8  # points across a sample of which it is the mean

    # Kernels of the pupil without an array
    # Degree of the polynomials over the pupil. Aberrated kernels need that of finer plans: where the defocus of some
    # part of the pupil undoes the aberration, polynomials have to follow this defocus.
    pupil_degree: int = 6
    part_degree: int = 5  # degree of the polynomials over each part of coded pupils, likewise
    lens_degree: int = 10  # degree of the polynomials over whole lenses in the image of the stop
    airy_reach: float = 24.0  # half width of kernels in lambda b / R: 0.4 % of the Airy pattern is beyond
    coarse_reach: float = 12.0  # that of coarse pixels, whose kernels are differences from the Airy pattern
    taper: float = 0.75  # part of half the width, or period, of a kernel from where it falls to zero
    airy_cell: float = 0.25  # widest cells of the grid in lambda b / R, which resolve the highest frequency
    most_airy_cells: int = 4  # most cells across a pixel
    coarse_cells: int = 2  # cells across coarser pixels
    least_transfer: float = 0.2  # smallest transfer by which the transfer of coarse pixels' kernels is divided
    finest_pixel: float = 0.04  # narrowest pixels in lambda b / R for which kernels fit into memory
    pupil_every: int = 37  # one of so many points of the pupil serves for the covariance
    small_aberration: float = 1 / 14  # in waves of 633 nm root mean square, up to which kernels alone have it
    most_aberration: float = 0.5  # largest one of higher than second order in kernels and polynomials

    # Kernels that are fitted to pupils of several parts
    least_closed: float = 0.02  # part of the middles of open points that must be closed for rays through closed parts
    unit_frequencies: int = 32  # image frequencies to R / lambda b: the period of kernels in lambda b / R
    fitted_blurs: int = 20  # blurs to which kernels are fitted, on each side of the focus
    widest_blur: float = 32.0  # the largest of them in units
    tilt_step: float = 0.5  # step of the small v in cycles to the pupil's radius
    tilt_limit: float = 0.25  # their limit over the degree plus one, as higher degrees follow faster changes
    tilt_weight: float = 0.3  # the part of all weight that they have
    noise_weight: float = 2e-4  # weight of the noise
    fitted_every: int = 9  # one of so many points of the pupil serves for the covariance

    # Wavelengths of signed rays
    spot_error: float = 3.0  # allowed error of a lens's spot over that of the capture, in which spots overlap
    least_spot_error: float = 1e-3  # smallest of these errors of captures
    # Largest blur from one node to the next, in lenses, over the square root of the capture's error: at 1.3 lenses rays
    # of a small patch of light through crown glass are wrong by 3 % of a band of 100 nm, and by 5 % of sRGB.
    node_blur: float = 13.0
    most_nodes: int = 32  # largest count of nodes of a band, unless `nodes` is given
    dense_wavelengths: int = 33  # wavelengths at which spots are compared, with linear interpolation between them
    spot_width: float = 4.0  # half the width of the compared spots in diffraction widths
    spot_samples: int = 4  # samples per diffraction width
    shared_pixel: float = 4.0  # width of pixels over that of spots from which channels may share a node
    density_steps: int = 2**14  # steps by which the responses from which wavelengths are drawn are integrated


USUAL = WaveAccuracy()
"""The numbers of usual plans."""

FINER = WaveAccuracy(
    degree=6,
    window=13,
    radial=24,
    tolerance=0.0012,
    cells=4.0,
    most_cells=3,
    pupil_degree=10,
    part_degree=7,
    lens_degree=16,
)
"""The numbers of finer plans."""
