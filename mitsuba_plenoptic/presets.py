"""Known cameras by name, as parameters of `PlenopticCamera`; `PlenopticCamera.preset` builds them.

``paper``
    The camera of the paper "Wave-Optical Reconstruction of Plenoptic Camera Images", unfocused: all numbers are the
    paper's.

``lytro``
    Like the first Lytro (F01), unfocused. From the metadata that such a camera writes into its files, as the test of
    imageio's reader for them quotes it (``tests/test_lytro.py``): 3280 x 3280 pixels of 1.4 um; hexagonal rows of
    lenses 14 um apart, turned by -0.000859 rad; 25 um from lenses to pixels; main lens of 6.84 mm at f/1.92. Ours:
    microlenses focused at infinity, as in Ng's design (2006, "Digital Light Field Photography"), as the files do not
    state their focal length; hexagonal apertures that fill the plane; thin lenses, so that the f-number gives the
    diameter; focused at 230 mm; no filter mosaic.

``raytrix``
    Like a Raytrix R12, focused, Galilean, with three focal lengths. From the calibration R12-A of Labussière, Teulière,
    Bernardin and Ait-Aider 2020, "Blur aware calibration of multi-focus plenoptic camera" (and 2022, "Leveraging blur
    information for plenoptic camera calibration"), rounded from the file ``examples/config/intrinsics.js`` of their
    program compote: 4080 x 3068 pixels of 5.5 um; hexagonal lenses 127.44 um apart with focal lengths of 0.583, 0.524
    and 0.561 mm; 0.3371 mm from lenses to pixels; main lens of 49.885 mm at f/4, 56.86 mm from the MLA. Ours: one lens
    on the axis, no turn (theirs is 0.002 degrees) and no distortion; thin lenses; no filter mosaic.

``paper_double_gauss``, ``raytrix_double_gauss``
    The cameras ``paper`` and ``raytrix`` behind a real lens: the bundled double Gauss, scaled to their focal lengths
    and closed to their apertures, as far from the MLA by its rear principal plane. So the same planes are in
    focus. Ours: the pairing; neither camera has this lens.

``lfm``
    A light-field microscope, a dry 20x/0.5 objective before square lenses of f/20, which is M / 2 NA, so that
    micro-images touch: the rule of Levoy, Ng, Adams, Footer and Horowitz 2006, "Light field microscopy". Ours: lenses
    150 um apart with the focal length of 3 mm that the rule gives them, a tube lens of 200 mm, one microlens on the
    axis, and 2048 x 2048 pixels of 6.5 um.

``lfm_water``
    The microscope of the light field of an ant's leg that the program napari-LF comes with, as the file
    ``src/napari_lf/examples/antleg/README`` of its repository PolarizedLightFieldMicroscopy/napari-LF describes it: a
    20x/0.5 water immersion objective in the index 1.33, a tube lens of 180 mm, an f/20 array of a pitch of 125 um and a
    focal length of 2.433 mm, pixels of 4.55 um (6.5 um behind a relay of 35/50). Ours: square lenses with one on the
    axis, and 2048 x 2048 pixels.

``flfm``
    A Fourier light-field microscope with the 40x/0.95 dry objective, the Fourier lens of 100 mm, the microlens focal
    length of 16.8 mm and the pixels of 6.5 um of Guo, Liu, Hua, Li and Jia 2019, "Fourier light-field microscopy",
    section 2.1. Ours: hexagonal lenses 679 um apart, so that seven are across the stop's image of 4.75 mm and see 101
    um, in place of their square ones 600 um apart, which see 89 um; the radius of the field stop, with which
    micro-images touch; one lens on the axis; 896 x 896 pixels.

``flfm_oil``
    The microscope that the program LFMNR comes with (``FLFM_simulation/main_FLFM_Simu.m`` of its repository
    feilab-hust/LFMNR): a 100x/1.4 oil immersion objective in the index 1.518, a tube lens of 180 mm, a Fourier lens of
    400 mm, lenses 3.25 mm apart with the focal length of 120 mm. With a Fourier lens of 300 mm it is that of Yi et al.
    2023, "Video-rate 3D imaging of living cells using Fourier view-channel-depth light field microscopy" (repository
    feilab-hust/F-VCD). Ours: the field stop, with which micro-images touch; 2048 x 2048 pixels of 6.5 um (theirs are
    3.25 mm over 499), which see the three by three lenses in the stop's image.

``telescope``
    A plenoptic wavefront sensor: an array in the focus of a telescope, whose lenses have the telescope's f-number, so
    that their images of its pupil touch: the rule of Clare and Lane 2005, "Wave-front sensing from subdivision of the
    focal plane with a lenslet array", and of Rodríguez-Ramos et al. 2012, "Concepts, laboratory, and telescope test
    results of the plenoptic camera as a wavefront sensor". The corner of four lenses is on the axis, as the tip of a
    pyramid sensor is. Ours: a pupil of 10 mm, as on an optical bench or behind the relay of a larger telescope, f/50,
    8 x 8 lenses of 0.32 mm, which are as wide as ten times the diffraction width (wavelength times f-number) of 633 nm,
    and 32 x 32 pixels of 10 um below each.

``shack_hartmann``
    A Shack-Hartmann wavefront sensor: the same telescope, whose pupil a collimator of 160 mm images onto an array of
    the same lenses, so that ten of them are across the pupil's image of 3.2 mm; 12 x 12 are before the detector. Ours:
    all numbers.

``full_frame_50mm``
    An ordinary camera of a film of 36 x 24 mm, without an array, behind the bundled double Gauss of 50 mm at f/2 (U.S.
    patent 2,673,491), which covers this film. The bundled `double_gauss` is made for 14 degrees and does not open
    beyond f/3. Ours: 6000 x 4000 pixels of 6 um, focused at 300 mm, where built-in scenes are.

``phone``
    A telephone's main camera without an array, behind the bundled lens of U.S. patent 8,934,179: 4.14 mm, f/2.3, five
    plastic lenses of even aspheres. Ours: 3200 x 2400 pixels of 1.4 um, which the lens covers to the corners, focused
    at 300 mm, no filter mosaic.

All have the `lens_model` ``ideal``: lenses of real cameras are corrected, and no aberrations then add to the difference
of rays and waves. The paper's own lenses are parabolic phases, which aberrate the light of ``paper`` by up to 0.74
waves of 633 nm over the field; `report.experiment`, which repeats its study, sets ``parabolic`` for rays and waves.
"""

from typing import Any

from .extension import entries, place

_RAYTRIX = {
    "focal_length": 49.885,
    "aperture_radius": 6.2356,
    "mla_distance": 56.86,
    "mla_focal_length": (0.583, 0.524, 0.561),
    "mla_pitch": 0.12744,
    "mla_lattice": "hexagonal",
    "detector_distance": 0.3371,
    "detector_width": 22.44,
    "resolution": (4080, 3068),
}

_WAVEFRONT_SENSOR = {
    "focal_length": 500.0,
    "aperture_radius": 5.0,
    "mla_focal_length": 16.0,
    "mla_pitch": 0.32,
}

PRESETS: dict[str, dict[str, Any]] = {
    "paper": {},
    "lytro": {
        "focal_length": 6.84,
        "aperture_radius": 1.78125,
        "mla_distance": 7.04967,
        "mla_focal_length": 0.025,
        "mla_pitch": 0.014,
        "mla_lattice": "hexagonal",
        "mla_rotation": -0.0492,
        "detector_distance": 0.025,
        "detector_width": 4.592,
        "resolution": (3280, 3280),
    },
    "raytrix": _RAYTRIX,
    "paper_double_gauss": {
        "main_lens": "double_gauss",
        "focal_length": 80.0,
        "aperture_radius": 5.0,
        "mla_distance": 120.0,
    },
    "raytrix_double_gauss": {"main_lens": "double_gauss", **_RAYTRIX},
    "lfm": {
        "main_lens": {"magnification": 20.0, "numerical_aperture": 0.5},
        "mla_focal_length": 3.0,
        "mla_pitch": 0.15,
        "mla_offset": (0.075, 0.075),
        "detector_width": 13.312,
        "resolution": (2048, 2048),
    },
    "lfm_water": {
        "main_lens": {"magnification": 20.0, "numerical_aperture": 0.5, "immersion": 1.33, "tube_focal_length": 180.0},
        "mla_focal_length": 2.433,
        "mla_pitch": 0.125,
        "mla_offset": (0.0625, 0.0625),
        "detector_width": 9.3184,
        "resolution": (2048, 2048),
    },
    "flfm": {
        "main_lens": {
            "magnification": 40.0,
            "numerical_aperture": 0.95,
            "arrangement": "fourier",
            "fourier_focal_length": 100.0,
            "field_stop": 2.0208,
        },
        "mla_focal_length": 16.8,
        "mla_pitch": 0.679,
        "mla_lattice": "hexagonal",
        "detector_width": 5.824,
        "resolution": (896, 896),
    },
    "flfm_oil": {
        "main_lens": {
            "magnification": 100.0,
            "numerical_aperture": 1.4,
            "immersion": 1.518,
            "tube_focal_length": 180.0,
            "arrangement": "fourier",
            "fourier_focal_length": 400.0,
            "field_stop": 5.4166,
        },
        "mla_focal_length": 120.0,
        "mla_pitch": 3.25,
        "mla_offset": (1.625, 1.625),
        "detector_width": 13.312,
        "resolution": (2048, 2048),
    },
    "telescope": _WAVEFRONT_SENSOR | {"mla_distance": 500.0, "detector_width": 2.56, "resolution": (256, 256)},
    "shack_hartmann": _WAVEFRONT_SENSOR
    | {"main_lens": {"collimator_focal_length": 160.0}, "detector_width": 3.84, "resolution": (384, 384)},
    "full_frame_50mm": {
        "mla_lattice": "none",
        "main_lens": "double_gauss_f2",
        "focal_length": 50.0,
        "focus_distance": 300.0,
        "detector_width": 36.0,
        "resolution": (6000, 4000),
    },
    "phone": {
        "mla_lattice": "none",
        "main_lens": "phone",
        "focus_distance": 300.0,
        "detector_width": 4.48,
        "resolution": (3200, 2400),
    },
}

PRESETS |= {name: place(package, text)[name] for package, name, text in entries("presets")}
