"""Trace one path of a render and describe it vertex by vertex; it is the path of the picture's sample, to the bit.

``torchpt render SCENE debug.pixel=[x,y]`` prints the result. An :class:`~torchpt.paths.explain.Explainer` records the events
of the path as it is traced (camera ray, intersection, emitter hit, scattering), in lanes of one; :class:`_PathBuilder` puts
those of one depth together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.core.threads import limited_threads
from torchpt.engines.engine import trace, weighted_radiance
from torchpt.paths.explain import CameraRay, Connection, EmitterHit, Explainer, Intersection, Scattering
from torchpt.paths.integrators import KINDS as INTEGRATORS
from torchpt.paths.integrators.path import PathIntegrator
from torchpt.paths.state import DirectLight, VertexOutput
from torchpt.paths.store import VertexStore
from torchpt.paths.wave import clamp_scale
from torchpt.physics.shapes import interact
from torchpt.scene import Scene
from torchpt.scene.names import Names
from torchpt.scene.prepare import make_wave
from torchpt.scene.settings import Settings

__all__ = ["BsdfSampleRecord", "ConnectionRecord", "EmissionRecord", "LightSampleRecord", "Path", "Vertex", "one_path"]

#: Three numbers: a colour, a point or a direction.
Triple = tuple[float, ...]


@dataclass(frozen=True)
class EmissionRecord:
    """Emission of a light that a camera ray or a BSDF sample hit.

    Attributes:
        light: name of the light.
        radiance: emitted radiance.
        pdf: density per solid angle with which light sampling would have drawn this direction.
        mis_weight: MIS weight of the BSDF sample.
        contribution: radiance added to the sample.
    """

    light: str
    radiance: Triple
    pdf: float
    mis_weight: float
    contribution: Triple


@dataclass(frozen=True)
class LightSampleRecord:
    """Light sample at a vertex, and its contribution.

    Attributes:
        light: name of the light.
        wi: direction to the light.
        pdf: density per solid angle, times the probability of the light; infinite for a delta light.
        arriving: radiance over pdf, before occlusion.
        bsdf: BSDF times cosine, times the factor of the shading normal (``DirectLight.share``): below 1 where perturbed normals
            shadow, 0 on the back of a one-sided surface.
        mis_weight: MIS weight of the light sample.
        visible: transmittance of the shadow ray, from 0 to 1; None where the contribution is 0 and no ray is traced.
        contribution: radiance added to the sample.
    """

    light: str
    wi: Triple
    pdf: float
    arriving: Triple
    bsdf: Triple
    mis_weight: float
    visible: float | None
    contribution: Triple


@dataclass(frozen=True)
class ConnectionRecord:
    """Connection of a vertex with one of a light path.

    Attributes:
        position: the other end.
        arriving: radiance that it would bring if nothing were in the way: with both BSDFs and the MIS weight.
        visible: transmittance of the ray between both, from 0 to 1.
        contribution: radiance added to the sample.
    """

    position: Triple
    arriving: Triple
    visible: float
    contribution: Triple


@dataclass(frozen=True)
class BsdfSampleRecord:
    """BSDF sample at a vertex.

    Attributes:
        wi: direction of the next ray.
        pdf: density per solid angle; infinite for a delta.
        weight: BSDF times cosine over pdf, with the shadowing of perturbed normals.
        eta: index of refraction on the side of ``wi`` over that of ``wo``; None for BSDFs that do not refract.
        survival: survival probability of Russian roulette; None before it begins.
        throughput: path throughput after the vertex; before roulette where that ends the path.
    """

    wi: Triple
    pdf: float
    weight: Triple
    eta: float | None
    survival: float | None
    throughput: Triple


@dataclass(frozen=True, kw_only=True)
class Vertex:
    """One vertex of a path: the hit or the escape of a ray. Positions and directions are in scene coordinates.

    Attributes:
        depth: number of the vertex, from 1.
        position: point of the hit; None, as the fields up to ``geometric_normal``, where the ray escaped.
        shape: name of the shape.
        kind: kind of the primitive.
        primitive: index of the primitive within its part of the shape.
        material: name of the material.
        model: the material's ``type``.
        normal: shading normal, on the side of ``wo`` where the material is opaque.
        geometric_normal: geometric normal, which points out of the shape.
        wo: direction to the previous vertex.
        emission: emission of the hit or of the environment; None if there is none.
        light: light sample; None if none was taken.
        connection: connection with a vertex of a light path; None if there is none, or no light goes through it.
        scattered: BSDF sample; None at the limit of depth.
        radiance: radiance that the path has gathered so far.
    """

    depth: int
    position: Triple | None = None
    shape: str | None = None
    kind: str | None = None
    primitive: int | None = None
    material: str | None = None
    model: str | None = None
    normal: Triple | None = None
    geometric_normal: Triple | None = None
    wo: Triple
    emission: EmissionRecord | None = None
    light: LightSampleRecord | None = None
    connection: ConnectionRecord | None = None
    scattered: BsdfSampleRecord | None = None
    radiance: Triple


@dataclass(frozen=True)
class Path:
    """One path and the value of its sample.

    Attributes:
        scene: name of the scene.
        pixel: ``(x, y)`` on the whole film.
        sample: index of the sample in its pixel.
        seed: seed of the render.
        origin: origin of the camera ray.
        direction: direction of the camera ray.
        vertices: surfaces that the path met, in order, and the environment where it escaped; the camera is none of them.
        ended: why the path ended: escaped, max_depth, absorbed, roulette or not finite.
        radiance: radiance of the whole path.
        value: value added to the film: weighted by the filter, 0 where it is not finite, clamped.
    """

    scene: str
    pixel: tuple[int, int]
    sample: int
    seed: int
    origin: Triple
    direction: Triple
    vertices: tuple[Vertex, ...]
    ended: str
    radiance: Triple
    value: Triple


def one_path(scene: Scene, settings: Settings, pixel: tuple[int, int], sample: int) -> Path:
    """Trace one sample by tensor operations, and describe its path.

    Args:
        scene: the scene.
        settings: settings of the render.
        pixel: ``(x, y)`` on the whole film.
        sample: index of the sample in its pixel.

    Raises:
        SceneError: the pixel or sample does not exist, or the integrator traces no paths.
    """
    film, spp = settings.film, settings.render.spp
    if not (0 <= pixel[0] < film.width and 0 <= pixel[1] < film.height):
        expected = f"a pixel [x,y] of the film of {film.width} x {film.height} pixels, counted from 0"
        raise SceneError("debug.pixel", list(pixel), expected)
    if not 0 <= sample < spp:
        raise SceneError("debug.sample", sample, f"a whole number from 0 to {spp - 1}, as render.spp is {spp}")
    if not isinstance(settings.integrator, PathIntegrator):
        kinds = {name: INTEGRATORS[name] for name in INTEGRATORS}
        names = ", ".join(
            name for name, kind in kinds.items() if issubclass(kind, PathIntegrator) and not kind().merges
        )
        expected = f"one that follows paths ({names}) beside debug.pixel"
        raise SceneError("integrator.type", settings.integrator.name, expected)
    if settings.integrator.merges:
        expected = "bdpt beside debug.pixel: merges take light from the paths of all pixels"
        raise SceneError("integrator.type", settings.integrator.name, expected)
    with torch.no_grad(), limited_threads(settings.render.threads):
        wave = make_wave(scene, settings, params=None, dtype=torch.float32).at_sample(sample)
        explainer = Explainer(wave.context.world)
        x, y, number = (torch.tensor([value], device=scene.device) for value in (*pixel, sample))
        store = None
        if wave.integrator.connects and wave.light_paths is not None:
            store = VertexStore(lanes=1)
            trace(wave.light_paths, wave.light_paths.rays_of(x, y, number), store=store)
        state = wave.rays_of(x, y, number)
        explainer.on_start(state)
        radiance = weighted_radiance(wave, state, observer=explainer, store=store)
        return _PathBuilder(scene, explainer).build(settings, pixel, sample, radiance)


class _PathBuilder:
    """Builds a :class:`Path` from the events that an observer recorded."""

    def __init__(self, scene: Scene, explainer: Explainer) -> None:
        self.scene, self.events, self.world = scene, explainer.events, explainer.world
        self.names = Names(scene.built, self.world)
        self.centre, self.unit = scene.space.centre, scene.space.unit

    def build(self, settings: Settings, pixel: tuple[int, int], sample: int, sample_value: Tensor) -> Path:
        """Return the path; ``sample_value (3, 1)``: its radiance, weighted by the filter."""
        camera_ray = self.events[0]
        assert isinstance(camera_ray, CameraRay)
        vertices = tuple(self._vertices())
        value = torch.where(torch.isfinite(sample_value).all(0), sample_value, 0.0)
        clamp = settings.integrator.clamp
        if clamp is not None:
            value = value * clamp_scale(value, clamp)
        return Path(
            scene=self.scene.name,
            pixel=pixel,
            sample=sample,
            seed=settings.render.seed,
            origin=self._scene_point(camera_ray.state.o),
            direction=_first_lane(camera_ray.state.d),
            vertices=vertices,
            ended=self._why_ended(),
            radiance=vertices[-1].radiance,
            value=_first_lane(value),
        )

    def _scene_point(self, p: Tensor) -> Triple:
        """Return a point in scene coordinates."""
        return tuple((p[:, 0].double() * self.unit + self.centre).tolist())

    def _vertices(self) -> Iterator[Vertex]:
        """Yield a vertex for each ray that was traced, whether it hit a surface or escaped."""
        for k, intersection in enumerate(self.events):
            # Ended paths have rays of length 0.
            if not isinstance(intersection, Intersection) or float(intersection.state.t_max) == 0.0:
                continue
            later = [event for event in self.events[k:] if not isinstance(event, CameraRay)]
            events = [event for event in later if event.depth == intersection.depth]
            emitter_hit = next((event for event in events if isinstance(event, EmitterHit)), None)
            scattering = next((event for event in events if isinstance(event, Scattering)), None)
            connection = next((event for event in events if isinstance(event, Connection)), None)
            yield self._vertex(intersection, emitter_hit, scattering, connection)

    def _vertex(
        self,
        intersection: Intersection,
        emitter_hit: EmitterHit | None,
        scattering: Scattering | None,
        connection: Connection | None,
    ) -> Vertex:
        """Return the vertex of a ray, whose events these are."""
        radiance = intersection.state.radiance
        if emitter_hit is not None:
            radiance = radiance + emitter_hit.light.brought
        light, output = None, None if scattering is None else scattering.output
        if scattering is not None and scattering.transmittance is not None:
            output = scattering.output
            assert output.direct is not None and output.shadow is not None
            light = self._light_sample(output.direct, output.shadow.radiance, scattering.transmittance)
            radiance = torch.addcmul(output.leaving.radiance, output.shadow.radiance, scattering.transmittance)
        connected = None
        if connection is not None:
            connected = self._connection(connection)
            radiance = radiance + connection.light.radiance * connection.transmittance
        wo, escaped = _first_lane(-intersection.state.d), int(intersection.hit.prim) < 0
        emission = None if emitter_hit is None else self._emission(emitter_hit)
        if escaped:
            return Vertex(depth=intersection.depth, wo=wo, emission=emission, radiance=_first_lane(radiance))
        at = interact(self.world, intersection.state.o, intersection.state.d, intersection.hit)
        found = self.names.surface(int(at.slot), int(at.prim))
        normal = at.ns if output is None or output.surface is None else output.surface.frame.n
        return Vertex(
            depth=intersection.depth,
            position=self._scene_point(at.p),
            shape=found.shape,
            kind=found.kind,
            primitive=found.primitive,
            material=found.material,
            model=found.model,
            normal=_first_lane(normal),
            geometric_normal=_first_lane(at.ng),
            wo=wo,
            emission=emission,
            light=light,
            connection=connected,
            scattered=None if output is None else _bsdf_sample(output),
            radiance=_first_lane(radiance),
        )

    def _emission(self, emitter_hit: EmitterHit) -> EmissionRecord:
        """Return the emission of a light that a ray hit."""
        lights = self.world.lights
        assert lights is not None
        row = len(lights.area) - 1  # the environment
        if emitter_hit.slot is not None:
            assert lights.row_of_prim is not None
            row = int(lights.row_of_prim[emitter_hit.slot])
        light = emitter_hit.light
        return EmissionRecord(
            self.names.light(row),
            _first_lane(light.radiance),
            float(light.pdf),
            float(light.weight),
            _first_lane(light.brought),
        )

    def _connection(self, connection: Connection) -> ConnectionRecord:
        light, transmittance = connection.light, connection.transmittance
        return ConnectionRecord(
            position=self._scene_point(light.o + light.d),
            arriving=_first_lane(light.radiance),
            visible=float(transmittance),
            contribution=_first_lane(light.radiance * transmittance),
        )

    def _light_sample(self, direct: DirectLight, unoccluded: Tensor, transmittance: Tensor) -> LightSampleRecord:
        sample, reflected = direct.sample, direct.reflected
        return LightSampleRecord(
            light=self.names.light(0 if sample.row is None else int(sample.row)),
            wi=_first_lane(sample.wi),
            pdf=float(sample.pdf),
            arriving=_first_lane(direct.radiance * sample.weight),
            bsdf=_first_lane(reflected if direct.share is None else reflected * direct.share),
            mis_weight=1.0 if direct.weight is None else float(direct.weight),
            visible=float(transmittance) if bool((unoccluded != 0).any()) else None,
            contribution=_first_lane(unoccluded * transmittance),
        )

    def _why_ended(self) -> str:
        """Return why the path ended."""
        last = next(event for event in reversed(self.events) if not isinstance(event, EmitterHit | Connection))
        if isinstance(last, Intersection) and float(last.state.t_max) > 0.0:
            return "escaped" if int(last.hit.prim) < 0 else "max_depth"
        output = next(event.output for event in reversed(self.events) if isinstance(event, Scattering))
        assert output.drawn is not None and output.carried is not None
        if not bool(torch.isfinite(output.carried).all()):
            return "not finite"
        # A valid sample (`least` above 0) that still carried light: nothing but roulette ends it.
        if float(output.drawn.least) > 0.0 and bool((output.carried > 0).any()):
            return "roulette"
        return "absorbed"


def _bsdf_sample(output: VertexOutput) -> BsdfSampleRecord:
    """Return the BSDF sample of a vertex."""
    # carried: throughput before roulette; chance: its survival probability; leaving: path state of the next ray.
    drawn, carried, chance, leaving = output.drawn, output.carried, output.chance, output.leaving
    assert drawn is not None and carried is not None and output.surface is not None
    goes_on, weight, perturbed_normal = float(leaving.t_max) > 0.0, drawn.weight, output.surface.perturbed_normal
    if perturbed_normal is not None:
        weight = weight * perturbed_normal.shadowing(drawn.d)
    return BsdfSampleRecord(
        wi=_first_lane(drawn.d),
        pdf=float(drawn.pdf),
        weight=_first_lane(weight),
        eta=None if drawn.eta is None else float(drawn.eta),
        survival=None if chance is None else float(chance),
        throughput=_first_lane(leaving.throughput if goes_on else carried),
    )


def _first_lane(value: Tensor) -> Triple:
    """Return the vector of the first lane."""
    return tuple(value.detach().reshape(3, -1)[:, 0].tolist())
