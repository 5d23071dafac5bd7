"""Render and time the runs of a study, keep them on disk, and resume; make references."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchpt.core.errors import AssetError, OutputError, SceneError
from torchpt.core.tree import fingerprint
from torchpt.core.version import __version__
from torchpt.engines.engine import wait_for_final_code
from torchpt.images import colour, read_image, read_layers, write_image
from torchpt.images.denoiser import check_denoiser, denoiser_version
from torchpt.images.metrics import relative
from torchpt.images.write import temporary_beside
from torchpt.rendering.api import Progress, Rendering, render_scene
from torchpt.rendering.result import denoise_rendering
from torchpt.reports.study import Study, Variant
from torchpt.scene.devices import device_of
from torchpt.scene.fingerprint import fingerprint as fingerprint_of
from torchpt.scene.formats.description import Description, overridden, read_description
from torchpt.scene.formats.overrides import override_words
from torchpt.scene.prepare import SceneCache, scene_cache
from torchpt.scene.scene import Scene
from torchpt.scene.settings import Settings, settings_with
from torchpt.spec import Role

__all__ = [
    "Curve",
    "Job",
    "Measured",
    "ReferencePicture",
    "Run",
    "Stopped",
    "Store",
    "film_size",
    "from_file",
    "from_runs",
    "machine",
    "measure",
    "name_of",
    "prepare",
    "seed_of",
    "write_whole",
]


# ---- Finished runs on disk: a picture and a JSON file each, from which a stopped study resumes
#
# A run's name is a hash of everything it depends on: the scene and its files, all settings, seed, spp, the renderer's source
# and the machine. So a changed study reuses the runs that are still valid, and no others. The JSON file is written after the
# picture: it marks a complete run.


#: Packages and files above rendering, on which no picture depends.
_WITHOUT_EFFECT = ("cli", "reports", "stress", "__main__.py", "share")


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        file: the picture, ``.exr``.
        facts: ``spp seed seconds set_up nonfinite_samples rays``, and what the run depends on.
    """

    file: Path
    facts: dict[str, Any]

    @property
    def seconds(self) -> float:
        """Seconds of sampling."""
        return self.facts["seconds"]

    def image(self) -> Tensor:
        """Return the picture ``(H, W, 3)`` float64."""
        return read_image(self.file)[..., :3].double()


class Store:
    """The folder of a study's runs.

    Args:
        folder: the folder, which is created if missing; studies may share it.

    Raises:
        OutputError: the folder cannot be created or written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            probe = temporary_beside(folder / "probe.json")
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise OutputError(folder, f"cannot be used for runs ({error.strerror or error})") from None

    def get(self, name: str) -> Run | None:
        """Return the run of this name; None if it is missing or incomplete."""
        try:
            facts = json.loads((self.folder / f"{name}.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        picture = self.folder / f"{name}.exr"
        whole = isinstance(facts, dict) and {"seconds", "spp", "seed", "nonfinite_samples"} <= facts.keys()
        return Run(picture, facts) if whole and picture.is_file() else None

    def put(self, name: str, image: Tensor, facts: Mapping[str, Any]) -> Run:
        """Write a run, and return it."""
        picture = self.folder / f"{name}.exr"
        write_image(picture, image)
        write_whole(self.folder / f"{name}.json", json.dumps(facts, indent=1).encode())
        return Run(picture, dict(facts))


def write_whole(path: Path, content: bytes) -> None:
    """Write a file atomically: to a temporary file, which is renamed.

    Raises:
        OutputError: the file cannot be written.
    """
    temporary = temporary_beside(path)
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(path, f"cannot be written ({error.strerror or error})") from None
    finally:
        with suppress(OSError):
            temporary.unlink()


def name_of(facts: Mapping[str, Any]) -> str:
    """Return the name of a run: a hash of these facts, the renderer and the machine."""
    all_facts = {"facts": facts, "torchpt": __version__, "source": _source(), "torch": torch.__version__, **machine()}
    return fingerprint(json.dumps(all_facts, sort_keys=True)).hex()


@lru_cache(maxsize=1)
def machine() -> dict[str, Any]:
    """Return what times depend on: processor, cores, threads, GPU."""
    processor = platform.processor() or platform.machine()
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        processor = next((line.partition(": ")[2] for line in lines if line.startswith("model name")), processor)
    facts: dict[str, Any] = {"processor": processor, "cores": os.cpu_count(), "threads": torch.get_num_threads()}
    if torch.cuda.is_available():
        facts["gpu"] = torch.cuda.get_device_name()
    return facts


@lru_cache(maxsize=1)
def _source() -> str:
    """Return a hash of the package's source, without the packages above rendering."""
    root = Path(__file__).parents[1]
    hashed = hashlib.blake2b(digest_size=12)
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root)
        if name.parts[0] not in _WITHOUT_EFFECT:
            hashed.update(str(name).encode() + path.read_bytes())
    return hashed.hexdigest()


# ---- References: a file, or the mean of independent runs, whose variance is subtracted from squared errors


@dataclass(frozen=True)
class ReferencePicture:
    """The reference of a scene.

    Attributes:
        image: ``(H, W, 3)`` float64.
        variance: variance of ``image``, of the same shape; 0 if unknown.
        runs: independent pictures ``(H, W, 3)`` of which ``image`` is the mean; empty for a file.
        origin: its origin, for the report: ``made`` is True for runs of the study, with their ``spp``, ``seeds``, ``seconds``
            and ``settings``; False for a ``file``, and ``variance`` is True if that has one.
    """

    image: Tensor
    variance: Tensor
    runs: tuple[Tensor, ...]
    origin: dict[str, Any]

    @cached_property
    def weight(self) -> Tensor:
        """Weight that makes squared errors relative: ``1 / (ref² + 0.01)``."""
        return relative(1.0, self.image)

    def shown(self, film: Any) -> Tensor:
        """Return the displayed reference; the latest is cached."""
        key = (film.exposure, film.tonemap, film.gamma)
        if key not in self._shown:
            self._shown.clear()
            self._shown[key] = colour.display(self.image, *key)
        return self._shown[key]

    @cached_property
    def _shown(self) -> dict[tuple[Any, ...], Tensor]:
        return {}

    @property
    def noise(self) -> float:
        """The reference's own relMSE, as far as known."""
        return float((self.variance * self.weight).mean())


def from_runs(runs: Sequence[Run]) -> ReferencePicture:
    """Return the mean of independent runs, with the variance of that mean."""
    images = tuple(run.image() for run in runs)
    stack = torch.stack(images)
    origin = {
        "made": True,
        "spp": runs[0].facts["spp"],
        "seeds": len(runs),
        "seconds": sum(run.seconds for run in runs),
        "settings": runs[0].facts["settings"],
    }
    return ReferencePicture(image=stack.mean(0), variance=stack.var(0) / len(runs), runs=images, origin=origin)


def from_file(path: str, size: tuple[int, int]) -> ReferencePicture:
    """Return a reference from a file; its layer ``variance`` (as ``film.aovs=[variance]`` writes it) is that of the mean.

    Args:
        path: a linear picture, such as ``.exr``.
        size: width and height that it must have.

    Raises:
        AssetError: the file cannot be read, has another size, or has values that are not finite.
    """
    layers = read_layers(path)
    image = layers["image"] if "image" in layers else next(iter(layers.values()))
    image = image.expand(-1, -1, 3) if image.shape[2] == 1 else image[..., :3]
    if image.shape[2] != 3:
        raise AssetError(path, f"expected a picture of 1, 3 or 4 channels, got {image.shape[2]}")
    (height, width), (film_width, film_height) = image.shape[:2], size
    if (width, height) != size:
        expected = f"expected a picture of {film_width} x {film_height} pixels as the film is"
        raise AssetError(path, f"{expected}, got {width} x {height}")
    if not torch.isfinite(image).all():
        raise AssetError(path, "expected finite values in a reference")
    variance = layers.get("variance")
    usable = variance is not None and variance.shape == image.shape and bool(torch.isfinite(variance).all())
    known = variance.double().clamp_min(0.0) if variance is not None and usable else torch.zeros_like(image).double()
    origin = {"made": False, "file": path, "variance": usable}
    return ReferencePicture(image=image.double(), variance=known, runs=(), origin=origin)


# ---- The runs of a study: which there are, and how they are timed
#
# Each step of a curve has independent runs with their own seeds. Settings are interleaved, seed by seed, so that a machine that
# slows down affects all of them. After each change of settings a warm-up run is discarded, which compiles and builds.
#
# Denoised curves render the runs again, with the same seeds and the AOVs that the denoiser needs: the noisy pictures are the
# same to the bit, and the times of the other curve do not include the AOVs.


#: Settings on which runs do not depend, or that differ from run to run.
_FREE = {
    "film": (*settings_with(Role.FREE)["film"], "aovs"),
    "render": (*settings_with(Role.FILES)["render"], "seed", "spp"),
}


class Stopped(Exception):
    """Raised when ``on_progress`` stops a study.

    Attributes:
        done: number of runs on disk.
        total: number of runs of the study.
    """

    def __init__(self, done: int, total: int) -> None:
        self.done, self.total = done, total
        super().__init__(done, total)


@dataclass
class Job:
    """Complete settings of a group of runs, which differ in spp and seed.

    Attributes:
        scene: the loaded scene.
        settings: complete settings; spp and seed are replaced for each run.
        facts: everything that runs depend on besides spp and seed.
        purpose: ``run`` or ``reference``, whose seeds differ.
        kept_cache: the scene's cache after the latest of these runs, while other settings use the scene.
    """

    scene: Scene
    settings: Settings
    facts: dict[str, Any]
    purpose: str
    kept_cache: SceneCache | None = None

    @property
    def pixels(self) -> int:
        """Number of pixels of the picture."""
        width, height = film_size(self.settings)
        return width * height


@dataclass
class Curve:
    """A variant on a scene.

    Attributes:
        variant: the settings.
        job: the settings as a job.
        steps: runs by spp.
        denoised: job of the runs that are denoised; None without ``denoise``.
        denoised_steps: runs with denoised pictures, by spp.
        reference: job of the reference; None if it is a file.
        reference_runs: runs of the reference.
    """

    variant: Variant
    job: Job
    steps: dict[int, list[Run]] = field(default_factory=dict)
    denoised: Job | None = None
    denoised_steps: dict[int, list[Run]] = field(default_factory=dict)
    reference: Job | None = None
    reference_runs: list[Run] = field(default_factory=list)


@dataclass
class Measured:
    """A scene of a study with its curves.

    Attributes:
        name: name or path of the scene.
        curves: the curves in the order of the grid.
    """

    name: str
    curves: list[Curve]


def film_size(settings: Settings) -> tuple[int, int]:
    """Return width and height of the picture."""
    film = settings.film
    if film.crop is None:
        return film.width, film.height
    _, _, width, height = film.crop
    return width, height


def seed_of(study_seed: int, purpose: str, spp: int, number: int) -> int:
    """Return the seed of a run, a hash of the arguments."""
    words = f"{study_seed}/{purpose}/{spp}/{number}"
    return int.from_bytes(hashlib.blake2b(words.encode(), digest_size=6).digest(), "big")


def prepare(study: Study) -> list[Measured]:
    """Load the scenes and check all settings, before anything is rendered.

    Raises:
        TorchptError: a scene or setting cannot be used, or the denoiser is missing.
    """
    if study.options["denoise"]:
        check_denoiser()
    found = []
    for name in study.scenes:
        # By the words of the overrides of the scene's keys: the description, and by device the scene with its fingerprint.
        known: dict[tuple[str, ...], tuple[Description, dict[str, tuple[Scene, str]]]] = {}
        curves = []
        for variant in study.variants:
            words = override_words(variant.changes)
            if words not in known:
                known[words] = read_description(name, overrides=variant.changes), {}
            description, loaded = known[words]
            curve = Curve(variant, _job(description, study.overrides(variant), loaded, "run"))
            if study.options["denoise"]:
                curve.denoised = _denoised(curve.job)
            if not study.reference.files:
                curve.reference = _job(description, study.reference_overrides(variant), loaded, "reference")
            curves.append(curve)
        found.append(Measured(name, curves))
    return found


def _job(
    description: Description,
    overrides: Mapping[str, Mapping[str, Any]],
    loaded: dict[str, tuple[Scene, str]],
    purpose: str,
) -> Job:
    """Return the job of a description with overrides; ``loaded``: scenes by device with fingerprints, which it may add to."""
    description, settings = overridden(description, overrides)
    # These settings of a scene concern files.
    film, render = settings.film.but(denoise=False, aovs=()), settings.render.without(Role.FILES)
    settings = replace(settings, film=film, render=render)
    if not settings.integrator.light:
        raise SceneError("integrator.type", settings.integrator.name, "an integrator that carries light")
    device = str(device_of(settings.render.device))
    if device not in loaded:
        scene = Scene(description, device_of(device))
        loaded[device] = scene, fingerprint_of(scene)
    scene, scene_fingerprint = loaded[device]
    facts = {"scene": scene_fingerprint, "device": device, "settings": settings.plain(_FREE)}
    return Job(scene=scene, settings=settings, facts=facts, purpose=purpose)


def _denoised(job: Job) -> Job:
    """Return the job of the same runs with the AOVs that the denoiser needs."""
    settings = replace(job.settings, film=job.settings.film.but(denoise=True))
    facts = {**job.facts, "settings": settings.plain(_FREE), "denoiser": denoiser_version()}
    return Job(scene=job.scene, settings=settings, facts=facts, purpose=job.purpose)


def measure(
    study: Study,
    prepared: list[Measured],
    store: Store,
    on_progress: Callable[[int, int, int, float], bool | None] | None = None,
) -> None:
    """Render missing runs, and add all runs to the curves.

    Args:
        study: the study.
        prepared: the scenes, from :func:`prepare`.
        store: the folder of runs.
        on_progress: called with samples done, samples in total, rays and seconds; returning True stops.

    Raises:
        Stopped: ``on_progress`` returned True; finished runs are kept.
    """
    planned = _all_runs(study, prepared)
    names = [_name(run.job, run.spp, run.seed) for run in planned]
    missing = {name: run.job.pixels * run.spp for name, run in zip(names, planned, strict=True)}  # samples by run
    missing = {name: samples for name, samples in missing.items() if store.get(name) is None}
    progress = _StudyProgress(sum(missing.values()), on_progress)
    latest: Job | None = None
    for name, (job, spp, seed, runs_of_step) in zip(names, planned, strict=True):
        run = store.get(name)
        if run is None:
            if job is not latest:  # other settings: warm up, so that caches are filled
                _swap_kernels(latest, job)
                warm_up = _render(job, min(study.options["spp"][0], spp), seed, progress, counts=False)
                wait_for_final_code()
                if not progress.stop:
                    _denoise(job, warm_up)  # the first call takes longer
                latest = job
            rendering = None if progress.stop else _render(job, spp, seed, progress, counts=True)
            if rendering is None or not rendering.complete:
                finished = sum(store.get(other) is not None for other in set(names))
                raise Stopped(done=finished, total=len(set(names)))
            denoising = _denoise(job, rendering)
            picture = rendering.image if rendering.denoised is None else rendering.denoised
            run = store.put(name, picture, _facts_of_run(job, spp, seed, rendering, denoising))
        runs_of_step.append(run)


def _swap_kernels(latest: Job | None, job: Job) -> None:
    """Swap cached kernels when settings change: a scene has those of its latest render only, and making them takes seconds."""
    if latest is not None:
        latest.kept_cache = replace(scene_cache(latest.scene))  # a copy: the scene's own is about to change
    if job.kept_cache is not None:
        cache = scene_cache(job.scene)
        cache.kernels, cache.first_surface = job.kept_cache.kernels, job.kept_cache.first_surface
        cache.without_lights = job.kept_cache.without_lights


class _PlannedRun(NamedTuple):
    """A run of a study, and ``runs_of_step``, the list that it is added to once it is finished."""

    job: Job
    spp: int
    seed: int
    runs_of_step: list[Run]


def _all_runs(study: Study, prepared: list[Measured]) -> list[_PlannedRun]:
    """Return all runs in the order in which they are rendered."""
    planned: list[_PlannedRun] = []
    for measured in prepared:
        for number in range(study.options["seeds"]):
            for curve in measured.curves:
                pairs = [(curve.job, curve.steps)]
                if curve.denoised is not None:
                    pairs.append((curve.denoised, curve.denoised_steps))
                for job, steps in pairs:
                    for spp in study.options["spp"]:
                        seed = seed_of(study.options["seed"], "run", spp, number)
                        planned.append(_PlannedRun(job, spp, seed, runs_of_step=steps.setdefault(spp, [])))
        shared: dict[str, Job] = {}  # curves with the same reference render it once
        for curve in measured.curves:
            if curve.reference is None:
                continue
            job = shared.setdefault(_name(curve.reference, 0, 0), curve.reference)
            for number in range(study.reference.seeds):
                seed = seed_of(study.options["seed"], "reference", study.reference.spp, number)
                planned.append(_PlannedRun(job, study.reference.spp, seed, runs_of_step=curve.reference_runs))
    return planned


def _name(job: Job, spp: int, seed: int) -> str:
    """Return the name of a run in the store."""
    return name_of({**job.facts, "purpose": job.purpose, "spp": spp, "seed": seed})


def _render(job: Job, spp: int, seed: int, progress: _StudyProgress, *, counts: bool) -> Rendering:
    """Render a run; ``counts``: False for a warm-up, which is no part of the study's progress."""
    settings = replace(job.settings, render=job.settings.render.but(spp=spp, seed=seed))
    rendering = render_scene(job.scene, settings, on_progress=progress.on_run if counts else progress.on_warm_up)
    if counts:
        progress.add(rendering)
    return rendering


def _denoise(job: Job, rendering: Rendering) -> float | None:
    """Denoise if the job asks for it; return the seconds, or None."""
    return denoise_rendering(rendering, job.settings) if job.settings.film.denoise else None


def _facts_of_run(job: Job, spp: int, seed: int, rendering: Rendering, denoising: float | None) -> dict[str, Any]:
    """Return the facts of a finished run for its JSON file; ``denoising``: seconds of it, or None."""
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


class _StudyProgress:
    """Progress of the whole study.

    Args:
        total: samples of all missing runs.
        report: called with samples done, samples in total, rays and seconds; returning True stops.

    Attributes:
        stop: True once the study is to stop.
    """

    def __init__(self, total: int, report: Callable[[int, int, int, float], bool | None] | None) -> None:
        self.total, self.report = total, report
        self.done, self.rays, self.seconds, self.stop = 0, 0, 0.0, False

    def on_run(self, state: Progress) -> bool:
        """Report the progress of a run; return True to stop."""
        if self.report is not None:
            done = self.done + state.done
            self.stop |= bool(self.report(done, self.total, self.rays + state.rays, self.seconds + state.seconds))
        return self.stop

    def on_warm_up(self, state: Progress) -> bool:
        """Return True to stop, during a run that is not counted."""
        if self.report is not None:
            self.stop |= bool(self.report(self.done, self.total, self.rays, self.seconds))
        return self.stop

    def add(self, rendering: Rendering) -> None:
        """Count a finished run."""
        self.done, self.rays = self.done + rendering.paths, self.rays + rendering.rays
        self.seconds += rendering.seconds
