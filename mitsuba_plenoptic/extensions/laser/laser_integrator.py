"""The integrator plugin ``plenoptic_laser``: captures of scenes with laser light."""

from typing import Any

import mitsuba as mi
import numpy as np

from ...camera import PlenopticCamera, Use, require_support
from ...errors import naming, refuse_if, require_count, require_number, require_wavelength, warn
from ...fields import OpticalSystem
from ...optics import Spectrum, guards
from ...plugins import properties, wave_base
from ...points import CaptureOperator, scene_points
from ...runtime import Floats, Job, Named
from ...scene import with_objects
from .lit_points import LaserScene, LitPoints, named_lasers
from .modes import mode_count
from .realisations import coherent_capture

NAME = "plenoptic_laser"

SOURCE = ("source_diameter", "source_distance", "bandwidth", "roughness")
"""Parameters of a source, from which the number of modes follows."""


def make_class() -> type:
    """Define the plugin's class for the active Mitsuba variant, to which its types are bound."""

    class PlenopticLaserIntegrator(wave_base.make_base()):  # type: ignore[misc]
        r"""Laser light: captures with speckle and fringes, together with all other light of the scene.

        .. pluginparameters::

         * - lasers
           - |string|
           - Ids of the emitters that are lasers, separated by commas: points, spots, projectors or directional emitters
         * - wavelength
           - |float|
           - Vacuum wavelength of the lasers in nanometres. (Default: 633)
         * - modes
           - |int|
           - Count of independent realisations whose intensities are averaged. (Default: 1, or by the source)
         * - source_diameter, source_distance
           - |float|
           - Instead of ``modes``: diameter of an incoherent disc from which the light comes, and its distance from the
             lit surfaces. (Default: a point)
         * - bandwidth, roughness
           - |float|
           - Instead of ``modes``: full width of the spectrum at half its maximum in nanometres, and root mean square
             height of the surfaces in millimetres. (Default: 0)
         * - points_per_spot
           - |float|
           - Number of points in each resolved spot, a square of side :math:`\lambda b / D_1` on the microlens array.
             (Default: 16)
         * - (Nested plugin)
           - :paramtype:`integrator`
           - Captures all other light, by rays like ``path`` or by waves like ``plenoptic_wave``. (Default: ``path``)

        All that the lasers light directly is mutually coherent within a realisation. Surfaces are rough, so that each
        of their points has a random phase, from the seed; where several lasers light one point, their fields add
        with the phases of their paths before, which makes fringes on the surface. The fields of all points propagate
        together through the main lens, the microlenses and to the detector, without paraxial approximation, and the
        intensity is integrated over the pixels. The mean over realisations has no speckle; the contrast of speckle on
        fields is :math:`1 / \sqrt N` for N ``modes``. From the size and spectrum of a source N follows as in
        `laser.mode_count`, for the mean distance of the lit points, rounded. The nested integrator captures the scene
        without the lasers, and the two intensities add: ``spp`` is for this part alone.

        Surfaces must be matte, and light of the lasers that is reflected more than once is left out. A point that an
        object hides from a part of the pupil has the field of an open pupil, and a guard states the fraction of this
        light. Gloss, mirrors, glass, masks, instances and media are refused by name, and so are area emitters as
        lasers, real main lenses, microscopes, moving scenes, variants other than mono ones and noise estimates. There
        are no gradients.

        .. tabs::
            .. code-tab:: xml

                <integrator type="plenoptic_laser">
                    <string name="lasers" value="spot"/>
                    <float name="wavelength" value="532"/>
                    <integer name="modes" value="2"/>
                    <integrator type="path"/>
                </integrator>

            .. code-tab:: python

                'type': 'plenoptic_laser',
                'lasers': 'spot',
                'wavelength': 532.0,
                'modes': 2,
                'child': {'type': 'path'}
        """

        plugin = NAME

        def __init__(self, props: Any):
            super().__init__(props)
            ids = properties.read_plain(props, "lasers", "")
            refuse_if(
                not isinstance(ids, str), f"{NAME}: lasers = {ids}: it must be ids of emitters, separated by commas"
            )
            self.lasers = [name.strip() for name in ids.split(",") if name.strip()]
            refuse_if(not self.lasers, f"{NAME}: lasers: give the id of at least one emitter")
            wavelength = properties.read_plain(props, "wavelength", wave_base.DEFAULT_WAVELENGTH)
            self.wavelengths = (require_wavelength(wavelength, f"{NAME}: wavelength"),)
            self.modes = None
            if "modes" in props:
                self.modes = require_count(f"{NAME}: modes", props["modes"])
            self.source = {
                name: require_number(f"{NAME}: {name}", properties.read_plain(props, name, 0), positive=True)
                for name in SOURCE
                if name in props
            }
            refuse_if(
                self.modes is not None and self.source, f"{NAME}: modes, {', '.join(self.source)}: give one of the two"
            )
            for name, needed in (("source_distance", "source_diameter"), ("roughness", "bandwidth")):
                refuse_if(
                    name in self.source and needed not in self.source,
                    f"{NAME}: {name}: it has a meaning with a {needed} only",
                )
            # 16.0: Default number of points in each resolved spot; the contrast of speckle is then smaller by 1.3 %.
            points = properties.read_plain(props, "points_per_spot", 16.0)
            self.points_per_spot = require_number(f"{NAME}: points_per_spot", points, positive=True)
            self.read_child(props)
            variant = mi.variant() or ""
            refuse_if(
                "_mono" not in variant or mi.is_polarized,
                f"{NAME}: variant {variant}: laser light has one wavelength; use llvm_ad_mono or cuda_ad_mono",
            )

        def record(
            self, scene: Any, sensor: Any, *, seed: int, spp: int, job: Job | None = None, noise: bool = False
        ) -> Any:
            """Compute the capture, and return the film that holds it; `spp` is for the nested integrator."""
            refuse_if(noise, f"{NAME}: noise: it is not estimated; compare seeds")
            lasers = self._require(scene, sensor)
            with guards.watch():
                image = self._laser(scene, sensor, lasers, seed, job or Job())
            unlit = with_objects(scene, (), lasers)
            if unlit.emitters():
                image = image + np.array(self.child.render(unlit, sensor, seed=seed, spp=spp), np.float32)[..., :1]
            wave_base.put(sensor.film(), image, 1)
            return sensor.film()

        def spectrum_of(self, scene: Any, sensor: Any) -> Spectrum | None:
            """Return None, as laser light has one wavelength."""
            return None

        def parameters(self) -> Named:
            """Return the parameters of this integrator by name, as for ``mi.load_dict``."""
            return {
                "lasers": ", ".join(self.lasers),
                "wavelength": self.wavelengths[0],
                **({} if self.modes is None else {"modes": self.modes}),
                **self.source,
                "points_per_spot": self.points_per_spot,
            }

        def _require(self, scene: Any, sensor: Any) -> list:
            """Return the lasers of a scene; refuse scenes and cameras that the model does not support."""
            with naming(NAME):
                require_support(PlenopticCamera.from_sensor(sensor), Use.COHERENT_POINTS)
            refuse_if(not sensor.film().rfilter().is_box_filter(), f'{NAME}: the film needs <rfilter type="box"/>')
            refuse_if(
                sensor.film().base_channels_count() != 1, f"{NAME}: the film has colours; use pixel_format luminance"
            )
            refuse_if(sensor.shutter_open_time() > 0, f"{NAME}: the shutter is open: it needs a scene at rest")
            refuse_if(sensor.get_medium() is not None, f"{NAME}: the sensor is in a medium: it needs empty space")
            scene_points.require_matte_surfaces(scene, NAME)
            return named_lasers(scene, self.lasers, NAME)

        def _laser(self, scene: Any, sensor: Any, lasers: list, seed: int, job: Job) -> Floats:
            """Return the light of the lasers, (rows, columns, 1)."""
            camera = PlenopticCamera.from_sensor(sensor)
            (wavelength,) = self.wavelengths
            system = OpticalSystem(camera.at_wavelength(wavelength), wavelength)
            points = LaserScene(scene, sensor, lasers, system).points(self.points_per_spot, seed)
            if not len(points.positions):
                warn(f"{NAME}: the camera sees no surface that the lasers light")
                return np.zeros((*camera.shape, 1), np.float32)
            operator = CaptureOperator(camera, points.positions, wavelength=wavelength, method="full_field")
            modes = self._modes_of(camera, points)
            return coherent_capture(operator, points.weights, modes=modes, seed=seed, job=job)[..., None]

        def _modes_of(self, camera: PlenopticCamera, points: LitPoints) -> int:
            """Return the number of modes: given directly, or computed for the size or spectrum of the source."""
            if self.modes is not None or not self.source:
                return self.modes or 1
            distance = float(np.average(points.positions[:, 2], weights=points.weights))
            with naming(NAME):
                count = mode_count(camera, wavelength=self.wavelengths[0], distance=distance, **self.source)
            return max(1, round(count))

    return PlenopticLaserIntegrator
