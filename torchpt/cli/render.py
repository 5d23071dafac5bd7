"""`torchpt render`: from a scene's name to files on disk and one line of JSON."""

from __future__ import annotations

import json
import math
import os
import secrets
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from torchpt.cli import distributed, gc_pause
from torchpt.cli.arguments import Arguments
from torchpt.cli.interrupt import Interrupt, Interrupted
from torchpt.cli.notices import not_finite, notices, unknown_error, which_job
from torchpt.cli.progress import Bar
from torchpt.cli.streams import flushed_stdout
from torchpt.cli.sweep_table import brief, error_of, note_job
from torchpt.core.errors import OutputError, RenderError, SceneError, TorchptError

__all__ = [
    "HELP",
    "Job",
    "check_distinct",
    "numbered",
    "plain",
    "render",
    "run",
    "scene_and_settings",
    "sentence",
    "with_error_pilots",
]

HELP = """\
torchpt render scene=NAME|FILE.yaml [out=FILE] [key=value ...]

  scene=   a file ending in .yaml, or a scene that ships:
{scenes}
  out=     .exr .hdr .png .jpg .ppm; several as out=[a.exr,a.png]; NAME.png where nothing is said
  {keys}
  {changes}
  debug.pixel=[x,y] debug.sample=k [--json]
                      print that path vertex by vertex, in place of a picture: [0,0] is at the upper left of the film

  integrator=NAME, sampler=NAME, ... take a group's file from configs/: integrator=direct sampler=independent
  --multirun, -m      one render for every combination: sampler=sobol,independent render.spp=16,64 scene=a,b out=x.exr
                      writes x_0.exr, x_1.exr, ...; summaries say which job has which settings, and a table ends stderr;
                      keys of the scene sweep as well: materials.floor.roughness=.1,.2,.4 camera.fov=range(20,50,10)
  --config-dir DIR, -cd
                      groups, scenes and configurations of your own: render=quick is DIR/render/quick.yaml, scene=room is
                      DIR/scene/room.yaml; --config-name NAME, -cn: DIR/NAME.yaml in place of configs/config.yaml
  --cfg job           print the composed settings and stop (null: the scene's own wish, else the built-in default)

  torchrun --nproc-per-node N -m torchpt render ...   N processes share the picture, to the same bits (docs/guides/ranks.md)

A sentence on stdout says what came of it; the last line is a summary in JSON. Samples that are not finite count as
black, and stderr says why.
Exit codes: 0; 2 bad input; 130 after Ctrl-C and 143 after SIGTERM, with the partial picture saved.
"""


@dataclass(frozen=True)
class Job:
    """One render, in plain values.

    Attributes:
        scene: a name, or the path of a scene file.
        overrides: block (``film integrator sampler render``) to the keys given on the command line.
        outs: pictures to write; ``<scene>.png`` in the current folder where empty.
        number: of the job in a sweep, which enters the file names; None outside one.
        words: what the command line says of this job, ``key=value`` each.
        changes: overrides of scene keys, as :func:`torchpt.load` takes them.
        config_dir: a folder of the caller's own, in whose folder ``scene`` defaults of scenes are looked for too.
        folder: where jobs of a sweep leave what came of them; None outside one.
    """

    scene: str
    overrides: dict[str, dict[str, Any]] = field(default_factory=dict)
    outs: tuple[str, ...] = ()
    number: int | None = None
    words: tuple[str, ...] = ()
    changes: dict[str, Any] = field(default_factory=dict)
    folder: str | None = None
    config_dir: str | None = None

    def facts(self) -> dict[str, Any]:
        """Return what a summary says of the words of a job, and of one of a sweep its number."""
        told = {"overrides": list(self.words)} if self.words or self.number is not None else {}
        return told if self.number is None else {"job": self.number, **told}


def numbered(path: str, number: int | None) -> str:
    """``a.exr`` as ``a_3.exr``: the number of a job in a sweep enters its file names."""
    if number is None:
        return path
    file = Path(path)
    return str(file.with_name(f"{file.stem}_{number}{file.suffix}"))


def run(job: Job, arguments: Arguments, interrupt: Interrupt) -> int:
    """Render a picture, or print one path of it; returns the exit code."""
    if not arguments.debug:
        return render(job, interrupt)
    from torchpt.cli.debug import PathRequest, debug

    return debug(job, PathRequest.read(arguments.debug), interrupt, arguments.json)


def render(job: Job, interrupt: Interrupt) -> int:
    """Render, write, print the summary; returns the exit code (0, or 128 + signal with the partial picture saved).

    Raises:
        TorchptError: bad input, found before anything is rendered wherever that is possible.
        Interrupted: a signal came while there was no picture to keep.
    """
    from torchpt.images import check_writable
    from torchpt.rendering.api import first_hit, render_scene
    from torchpt.rendering.checkpoint import CheckpointFile
    from torchpt.rendering.result import write_rendered
    from torchpt.scene.devices import device_of
    from torchpt.scene.scene import Scene

    gc_pause.resume()
    start = time.perf_counter()
    group = distributed.group()
    first = group is None or group.rank == 0  # which alone writes
    with notices():
        description, settings = scene_and_settings(job)
        settings = with_error_pilots(settings)
        outs = _outputs(job, settings)
        preview = settings.render.preview and numbered(str(Path(settings.render.preview).expanduser()), job.number)
        previews = _preview_files(preview) if preview else []
        denoised = _denoised_files(settings, outs)
        kept = settings.render.checkpoint and numbered(str(Path(settings.render.checkpoint).expanduser()), job.number)
        check_distinct(
            [
                *(("out", path) for path in outs),
                *(("render.preview", path) for path in previews),
                *((("render.checkpoint", kept),) if kept else ()),
                *(("film.denoise", path) for path in denoised),
            ]
        )
        for path in (*outs, *previews, *denoised) if first else ():
            check_writable(path)
        if kept is not None:
            settings = replace(settings, render=settings.render.but(checkpoint=kept))
            if first:
                CheckpointFile(kept).check(settings.render.resume)
        scene = Scene(description, device_of(settings.render.device))
    scene.load_seconds = time.perf_counter() - start
    if first:
        which_job(job, outs)
    if preview and first:
        hits = first_hit(scene, settings)
        for path, name in zip(previews, ("albedo", "normal"), strict=False):
            _write_layer(path, name, hits[name])

    shared: dict[str, Any] = {} if group is None else {"ranks": group}
    with Bar(_name(job.scene)) as bar:

        def on_progress(state: Any) -> bool:
            bar.update(state.done, state.total, state.rays, state.seconds)
            if preview and first and state.pass_finished and state.done < state.total:
                write_rendered(preview, state.snapshot(), settings.film)
            return interrupt.signum is not None

        rendering = _keeping(interrupt, lambda: render_scene(scene, settings, on_progress=on_progress, **shared))
    if group is not None:  # a signal that any of them heard
        interrupt.signum = int(max(group.all_gather_numbers("signals", interrupt.signum or 0))[0]) or None
    if not first:
        return 0 if interrupt.signum is None else Interrupted(interrupt.signum).exit_code
    facts = _write_all([*outs, *((preview,) if preview else ())], denoised, rendering, settings)
    summary = {"out": _names(outs), **job.facts(), **facts, **rendering.summary()}
    if not rendering.complete:
        summary["complete"] = False
    not_finite(summary)
    unknown_error(summary)
    summary = plain(summary, digits=6)
    height, width = rendering.image.shape[:2]
    with flushed_stdout():  # in one piece, as jobs of a sweep may share stdout; the last line is the summary
        print(f"{sentence(summary, width, height)}\n{json.dumps(summary, allow_nan=False)}")
    note_job(job, summary)
    if interrupt.signum is None:
        return 0
    again = "" if settings.render.checkpoint is None else "; render.resume=true goes on"
    print(f"torchpt: stopped by a signal; {outs[0]} holds the picture so far{again}", file=sys.stderr)
    return Interrupted(interrupt.signum).exit_code


def scene_and_settings(job: Job) -> tuple[Any, Any]:
    """The description and the complete settings of a job; a null given on the command line unsets the scene's own wish.

    Raises:
        TorchptError: a scene or setting that cannot be used.
    """
    from torchpt.scene.formats.description import overridden, read_description

    places = () if job.config_dir is None else (Path(job.config_dir, "scene"),)
    return overridden(read_description(job.scene, overrides=job.changes, places=places), job.overrides)


def with_error_pilots(settings: Any) -> Any:
    """Settings of a picture that a command writes: ``render.pilots: auto`` is true there, as its summary tells the error."""
    render = settings.render
    able = render.pilots == "auto" and not settings.integrator.splats
    return replace(settings, render=render.but(pilots=True)) if able else settings


def _keeping(interrupt: Interrupt, work: Callable[[], Any]) -> Any:
    """Do the work whose result is kept: a signal only ends it early."""
    interrupt.check()
    interrupt.deferred = True
    return work()


def _name(scene: str) -> str:
    path = Path(scene)
    return path.stem if path.suffix in (".yaml", ".yml") else path.name


def _outputs(job: Job, settings: Any) -> list[str]:
    """Where the picture goes; layers that no file would keep are an error."""
    layers = [name for name in settings.film.aovs or ()]
    outs = [str(Path(path).expanduser()) for path in job.outs]
    if not outs:
        outs = [_name(job.scene) + (".exr" if layers else ".png")]
    if layers and "aovs" in job.overrides.get("film", {}) and not any(_is_exr(path) for path in outs):
        raise SceneError("film.aovs", layers, "a picture ending in .exr among out= (no other format keeps layers)")
    return [numbered(path, job.number) for path in outs]


def check_distinct(files: Sequence[tuple[str, str]]) -> None:
    """Refuse two files to write that are one, however their paths are spelled.

    Args:
        files: key and path of each.

    Raises:
        SceneError: names the later one's key and path, and the file that it would replace.
    """
    seen: dict[str, tuple[str, str]] = {}
    for key, path in files:
        with suppress(OSError, ValueError):  # of a path that cannot be, which is told where it is tried
            place = os.path.normcase(os.path.realpath(path))
            if place in seen:
                other, before = seen[place]
                raise SceneError(key, path, f"another file than {before!r} of {other}")
            seen[place] = key, path


def _is_exr(path: str) -> bool:
    return Path(path).suffix.lower() == ".exr"


def _denoised_files(settings: Any, outs: list[str]) -> list[str]:
    """Return where the denoised pictures go, one for each of ``outs``; none where none is wanted.

    Raises:
        RenderError: there is no denoiser.
    """
    if not settings.film.denoise:
        return []
    from torchpt.images.denoiser import check_denoiser
    from torchpt.rendering.result import beside

    check_denoiser()
    return [beside(path) for path in outs]


def _preview_files(preview: str) -> list[str]:
    """Albedo, normal, and the picture itself."""
    path = Path(preview)
    return [*(str(path.with_name(f"{path.stem}.{name}{path.suffix}")) for name in ("albedo", "normal")), preview]


def _write_all(paths: list[str], denoised: list[str], rendering: Any, settings: Any) -> dict[str, Any]:
    """Write every picture that can be written before complaining of one that cannot; returns what there is to tell."""
    from torchpt.rendering.result import denoise_rendering, write_denoised, write_rendered

    failed: list[TorchptError] = []
    facts: dict[str, Any] = {}
    for path in paths:
        try:
            write_rendered(path, rendering, settings.film)
        except OutputError as error:
            elsewhere = _written_elsewhere(path, rendering, settings)
            if elsewhere is not None:
                error = OutputError(path, f"{error.problem}; the picture is in {elsewhere}")
            failed.append(error)
    try:
        if denoised:  # only now: what was rendered is safe
            facts = {"denoised": _names(denoised), "denoise_seconds": round(denoise_rendering(rendering, settings), 4)}
            for path in denoised:
                try:
                    write_denoised(path, rendering, settings.film)
                except OutputError as error:
                    failed.append(error)
    except RenderError as error:
        failed.append(error)
    if len(failed) > 1:
        raise TorchptError("; ".join(map(str, failed)))
    if failed:
        raise failed[0]
    return facts


def _written_elsewhere(path: str, rendering: Any, settings: Any) -> str | None:
    """Save a picture whose place went away while it was rendered; returns where it is, under a name that nothing had."""
    from torchpt.rendering.result import write_rendered

    name = Path(path)
    for place in (os.path.expanduser("~"), tempfile.gettempdir()):
        spare = Path(place) / f"{name.stem}-{secrets.token_hex(3)}{name.suffix}"
        if Path(place).is_dir():
            with suppress(OutputError):
                write_rendered(spare, rendering, settings.film)
                return str(spare)
    return None


def _write_layer(path: str, name: str, layer: Any) -> None:
    """A layer as a picture of its own; in 8 bits, a normal's -1..1 is shown as 0..1."""
    from torchpt.images import write_image

    shown = 0.5 * layer + 0.5 if name == "normal" and not _is_exr(path) else layer
    write_image(path, shown, gamma=1.0 if name == "normal" else "srgb")


def _names(paths: list[str]) -> str | list[str]:
    return paths[0] if len(paths) == 1 else paths


def sentence(facts: Mapping[str, Any], width: int, height: int) -> str:
    """Return the summary of a render in a sentence for people.

    Args:
        facts: the summary, as JSON has it.
        width: of the picture in pixels.
        height: of the picture in pixels.
    """
    out, spp = facts["out"], facts["spp"]
    text = f"{out if isinstance(out, str) else ', '.join(out)}: {width} x {height} pixels, "
    text += f"{spp} sample{'' if spp == 1 else 's'} a pixel, {brief(facts['seconds'])} s"
    if error := error_of(facts):
        text += f"; relative error {error}"
    if not facts.get("complete", True):
        text += "; stopped early"
    elif "stopped_by" in facts:
        text += f"; ended by render.{facts['stopped_by']}"
    return text


def plain(value: Any, digits: int = 17) -> Any:
    """Return a value as JSON has it, which knows neither NaN nor tensors; floats to so many significant digits."""
    if isinstance(value, dict):
        return {str(key): plain(item, digits) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist(), digits)
    if isinstance(value, list | tuple):
        return [plain(item, digits) for item in value]
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    return value
