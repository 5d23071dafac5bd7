"""The runs of a study: which there are, and how each is timed.

Every step of a curve has independent runs with seeds of their own. Settings take turns, one seed after the other, so that a
machine that slows down slows all of them. Whenever they change, a run that is thrown away comes first: what it compiles and
builds is no run's time.

For the denoised pictures of a curve its runs are rendered once more, by the same seeds and with the layers that the denoiser
looks at: the picture under the noise is the same to the bit, and the curve's own times are without those layers.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from torchpt.errors import SceneError
from torchpt.format.description import Description, overridden, read_description
from torchpt.forward.denoising import denoise_rendering
from torchpt.forward.kept import Kept, kept
from torchpt.images.denoiser import check_denoiser, denoiser_version
from torchpt.rendering import Progress, Rendering, render_scene
from torchpt.reports.grid import Variant
from torchpt.reports.store import Run, Store, name_of
from torchpt.reports.study import Study
from torchpt.scene.devices import device_of
from torchpt.scene.fingerprint import fingerprint
from torchpt.scene.scene import Scene
from torchpt.settings import Settings, having
from torchpt.spec import Role

__all__ = ["Curve", "Job", "Measured", "Stopped", "film_size", "measure", "prepare", "seed_of"]

#: Settings that no run depends on, or that each has its own of.
_FREE = {
    "film": (*having(Role.FREE)["film"], "aovs"),
    "render": (*having(Role.FILES)["render"], "seed", "spp"),
}


class Stopped(Exception):
    """A wish to stop was met.

    Attributes:
        done: runs that are kept.
        total: runs of the study.
    """

    def __init__(self, done: int, total: int) -> None:
        self.done, self.total = done, total
        super().__init__(done, total)


@dataclass
class Job:
    """Settings of which runs are wanted.

    Attributes:
        scene: loaded.
        wishes: complete; spp and seed are set for each run.
        facts: what runs depend on, beside spp and seed.
        purpose: ``run`` or ``reference``: their seeds never meet.
        left: what its runs left for the next one: its kernels, while those of another setting are in the scene's hands.
    """

    scene: Scene
    wishes: Settings
    facts: dict[str, Any]
    purpose: str
    left: Kept | None = None

    @property
    def pixels(self) -> int:
        """Of the picture."""
        wide, high = film_size(self.wishes)
        return wide * high


@dataclass
class Curve:
    """A variant on a scene.

    Attributes:
        variant: its settings.
        job: how it is run.
        steps: spp to its runs.
        denoised: how the runs are rendered that are denoised; None where none are wanted.
        denoised_steps: spp to those runs, whose pictures are the denoised ones.
        reference: how its reference is made; None where that is a file.
        truths: the runs of the reference.
    """

    variant: Variant
    job: Job
    steps: dict[int, list[Run]] = field(default_factory=dict)
    denoised: Job | None = None
    denoised_steps: dict[int, list[Run]] = field(default_factory=dict)
    reference: Job | None = None
    truths: list[Run] = field(default_factory=list)


@dataclass
class Measured:
    """A scene of a study with its curves.

    Attributes:
        name: as it was asked for.
        curves: in the order of the grid.
    """

    name: str
    curves: list[Curve]


def film_size(wishes: Settings) -> tuple[int, int]:
    """Width and height of the picture."""
    film = wishes.film
    return (film.width, film.height) if film.crop is None else film.crop[2:]


def seed_of(study_seed: int, purpose: str, spp: int, number: int) -> int:
    """The seed of a run: another one for each purpose, step and number."""
    words = f"{study_seed}/{purpose}/{spp}/{number}"
    return int.from_bytes(hashlib.blake2b(words.encode(), digest_size=6).digest(), "big")


def prepare(study: Study) -> list[Measured]:
    """Load the scenes and check every setting, before anything is rendered.

    Raises:
        TorchptError: a scene or setting that cannot be used; a denoiser that is wanted and not there.
    """
    if study.asked["denoise"]:
        check_denoiser()
    found = []
    for name in study.scenes:
        description = read_description(name)
        loaded: dict[str, tuple[Scene, str]] = {}
        curves = []
        for variant in study.variants:
            curve = Curve(variant, _job(description, study.overrides(variant), loaded, "run"))
            if study.asked["denoise"]:
                curve.denoised = _denoised(curve.job)
            if not study.reference.files:
                curve.reference = _job(description, study.truth(variant), loaded, "reference")
            curves.append(curve)
        found.append(Measured(name, curves))
    return found


def _job(
    description: Description,
    overrides: Mapping[str, Mapping[str, Any]],
    loaded: dict[str, tuple[Scene, str]],
    purpose: str,
) -> Job:
    description, wishes = overridden(description, overrides)
    # Such wishes of a scene are about files.
    film, render = wishes.film.but(denoise=False, aovs=()), wishes.render.without(Role.FILES)
    wishes = replace(wishes, film=film, render=render)
    if not wishes.integrator.light:
        raise SceneError("integrator.type", wishes.integrator.name, "an integrator that carries light")
    device = str(device_of(wishes.render.device))
    if device not in loaded:
        scene = Scene(description, device_of(device))
        loaded[device] = scene, fingerprint(scene)
    scene, named = loaded[device]
    return Job(scene, wishes, {"scene": named, "device": device, "settings": wishes.plain(_FREE)}, purpose)


def _denoised(job: Job) -> Job:
    """The same runs with the layers that the denoiser looks at."""
    wishes = replace(job.wishes, film=job.wishes.film.but(denoise=True))
    facts = {**job.facts, "settings": wishes.plain(_FREE), "denoiser": denoiser_version()}
    return Job(job.scene, wishes, facts, job.purpose)


def measure(
    study: Study,
    prepared: list[Measured],
    store: Store,
    on_progress: Callable[[int, int, int, float], bool | None] | None = None,
) -> None:
    """Render what is missing and fill in the runs.

    Args:
        study: what is asked.
        prepared: from `prepare`.
        store: where runs are kept.
        on_progress: called with samples done and to do, rays and seconds; returning True stops.

    Raises:
        Stopped: ``on_progress`` said so; finished runs are kept.
    """
    wanted = _wanted(study, prepared)
    names = [_name(job, spp, seed) for job, spp, seed, _ in wanted]
    missing = {name: job.pixels * spp for name, (job, spp, _, _) in zip(names, wanted, strict=True)}
    missing = {name: samples for name, samples in missing.items() if store.get(name) is None}
    clock = _Clock(sum(missing.values()), on_progress)
    latest: Job | None = None
    for name, (job, spp, seed, place) in zip(names, wanted, strict=True):
        run = store.get(name)
        if run is None:
            if job is not latest:  # what it leaves is there for the runs that follow
                _turn(latest, job)
                thrown = _render(job, min(study.asked["spp"][0], spp), seed, clock, counts=False)
                if not clock.stop:
                    _denoise(job, thrown)  # its first time takes longer too
                latest = job
            rendering = None if clock.stop else _render(job, spp, seed, clock)
            if rendering is None or not rendering.complete:
                raise Stopped(sum(store.get(other) is not None for other in set(names)), len(set(names)))
            denoising = _denoise(job, rendering)
            picture = rendering.image if rendering.denoised is None else rendering.denoised
            run = store.put(name, picture, _told(job, spp, seed, rendering, denoising))
        place.append(run)


def _turn(latest: Job | None, job: Job) -> None:
    """Another setting's turn: a scene keeps the kernels of its latest render only, and making them anew takes seconds."""
    if latest is not None:
        latest.left = replace(kept(latest.scene))
    if job.left is not None:
        keeper = kept(job.scene)
        keeper.kernels, keeper.first, keeper.dark = job.left.kernels, job.left.first, job.left.dark


Wanted = tuple[Job, int, int, list[Run]]


def _wanted(study: Study, prepared: list[Measured]) -> list[Wanted]:
    """All runs in order, each with the list that it goes to."""
    found: list[Wanted] = []
    for measured in prepared:
        for number in range(study.asked["seeds"]):
            for curve in measured.curves:
                pairs = [(curve.job, curve.steps)]
                if curve.denoised is not None:
                    pairs.append((curve.denoised, curve.denoised_steps))
                for job, steps in pairs:
                    for spp in study.asked["spp"]:
                        seed = seed_of(study.asked["seed"], "run", spp, number)
                        found.append((job, spp, seed, steps.setdefault(spp, [])))
        shared: dict[str, Job] = {}
        for curve in measured.curves:
            if curve.reference is None:
                continue
            job = shared.setdefault(_name(curve.reference, 0, 0), curve.reference)
            for number in range(study.reference.seeds):
                seed = seed_of(study.asked["seed"], "reference", study.reference.spp, number)
                found.append((job, study.reference.spp, seed, curve.truths))
    return found


def _name(job: Job, spp: int, seed: int) -> str:
    return name_of({**job.facts, "purpose": job.purpose, "spp": spp, "seed": seed})


def _render(job: Job, spp: int, seed: int, clock: _Clock, counts: bool = True) -> Rendering:
    wishes = replace(job.wishes, render=job.wishes.render.but(spp=spp, seed=seed))
    rendering = render_scene(job.scene, wishes, on_progress=clock.watch if counts else clock.glance)
    if counts:
        clock.passed(rendering)
    return rendering


def _denoise(job: Job, rendering: Rendering) -> float | None:
    """Denoise where that is wanted; returns the seconds that it took."""
    return denoise_rendering(rendering, job.wishes) if job.wishes.film.denoise else None


def _told(job: Job, spp: int, seed: int, rendering: Rendering, denoising: float | None) -> dict[str, Any]:
    set_up = rendering.build_seconds + rendering.compile_seconds
    seconds = getattr(rendering, "render_seconds", None) or max(rendering.seconds - set_up, 1e-9)
    return {
        "spp": spp,
        "seed": seed,
        "seconds": seconds + (denoising or 0.0),
        "denoise_seconds": denoising,
        "set_up": set_up,
        "rays": rendering.rays,
        "nonfinite_samples": rendering.nonfinite_samples,
        "truncated_paths": rendering.truncated_paths,
        "clamped": rendering.clamped,
        "purpose": job.purpose,
        **job.facts,
    }


class _Clock:
    """How far all of the study is."""

    def __init__(self, total: int, tell: Callable[[int, int, int, float], bool | None] | None) -> None:
        self.total, self.tell = total, tell
        self.done, self.rays, self.seconds, self.stop = 0, 0, 0.0, False

    def watch(self, state: Progress) -> bool:
        """Tell of a run on its way."""
        if self.tell is not None:
            done = self.done + state.done
            self.stop |= bool(self.tell(done, self.total, self.rays + state.rays, self.seconds + state.seconds))
        return self.stop

    def glance(self, state: Progress) -> bool:
        """Ask only whether to stop."""
        if self.tell is not None:
            self.stop |= bool(self.tell(self.done, self.total, self.rays, self.seconds))
        return self.stop

    def passed(self, rendering: Rendering) -> None:
        """Count a finished run."""
        self.done, self.rays = self.done + rendering.paths, self.rays + rendering.rays
        self.seconds += rendering.seconds
