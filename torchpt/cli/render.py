"""`torchpt render`: load a scene, render it, write the pictures and print a summary in JSON."""

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
from torchpt.cli.notices import print_job, printed_scene_warnings, warn_nonfinite, warn_unknown_error
from torchpt.cli.progress import Bar
from torchpt.cli.streams import flushed_stdout
from torchpt.cli.sweep_table import error_of, record_job, two_digits
from torchpt.core.errors import OutputError, RenderError, SceneError, TorchptError
from torchpt.core.files import written_path

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
torchpt render scene=NAME|FILE.yaml|FILE.xml [out=FILE] [key=value ...]

  scene=   a file ending in .yaml or .xml (Mitsuba), or a scene that ships:
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
  --cfg job           print the composed settings and stop (null: the scene's value, else the built-in default)

  torchrun --nproc-per-node N -m torchpt render ...   N processes share the picture, to the same bits (docs/guides/ranks.md)

A sentence on stdout says what came of it; the last line is a summary in JSON. Samples that are not finite count as
black, and stderr says why.
Exit codes: 0; 2 bad input; 130 after Ctrl-C and 143 after SIGTERM, with the partial picture saved.
"""


@dataclass(frozen=True)
class Job:
    """One render, described by plain values.

    Attributes:
        scene: name of a shipped scene, or path of a scene file.
        overrides: settings of the command line, by block (``film integrator sampler render``) and key.
        outs: files to write; if empty, ``<scene>.png`` in the working folder, or ``.exr`` with ``film.aovs``.
        number: index of the job in a sweep, part of the file names; None outside a sweep.
        words: overrides of this job as ``key=value``, for messages and the summary.
        changes: overrides of scene keys, as :func:`torchpt.load` takes them.
        config_dir: the user's config folder; ``defaults`` of scenes are also looked for in its subfolder ``scene``.
        folder: folder in which the jobs of a sweep write their results; None outside a sweep.
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
        """Return the overrides of the job, and in a sweep its number, for the summary."""
        overrides = {"overrides": list(self.words)} if self.words or self.number is not None else {}
        return overrides if self.number is None else {"job": self.number, **overrides}


def numbered(path: str, number: int | None) -> str:
    """Append the number of a sweep's job to a file name: ``a.exr`` becomes ``a_3.exr``; None leaves it as it is."""
    if number is None:
        return path
    file = Path(path)
    return str(file.with_name(f"{file.stem}_{number}{file.suffix}"))


def run(job: Job, arguments: Arguments, interrupt: Interrupt) -> int:
    """Render a picture, or print one path of it, and return the exit code."""
    if not arguments.debug:
        return render(job, interrupt)
    from torchpt.cli.debug import PathRequest, debug

    return debug(job, PathRequest.read(arguments.debug), interrupt, as_json=arguments.json)


def render(job: Job, interrupt: Interrupt) -> int:
    """Render, write the pictures, print the summary; return 0, or 128 + signal with the partial picture saved.

    Raises:
        TorchptError: bad input, found before rendering where possible.
        Interrupted: a signal arrived before there was a picture to keep.
    """
    from torchpt.images import check_writable
    from torchpt.rendering.api import first_hit, render_scene
    from torchpt.rendering.checkpoint import CheckpointFile
    from torchpt.rendering.result import write_rendered
    from torchpt.scene.devices import device_of
    from torchpt.scene.scene import Scene

    gc_pause.resume()  # the imports are done: collect garbage again
    start = time.perf_counter()
    group = distributed.group()
    writes_files = group is None or group.rank == 0
    with printed_scene_warnings():
        description, settings = scene_and_settings(job)
        settings = with_error_pilots(settings)
        outs = _outputs(job, settings)
        preview = settings.render.preview and numbered(
            str(written_path(settings.render.preview, "render.preview")), job.number
        )
        previews = _preview_files(preview) if preview else []
        denoised = _denoised_files(settings, outs)
        checkpoint = settings.render.checkpoint
        if checkpoint:
            checkpoint = numbered(str(written_path(checkpoint, "render.checkpoint")), job.number)
        check_distinct(
            [
                *(("out", path) for path in outs),
                *(("render.preview", path) for path in previews),
                *((("render.checkpoint", checkpoint),) if checkpoint else ()),
                *(("film.denoise", path) for path in denoised),
            ]
        )
        _check_jpeg([*outs, *previews, *denoised], settings)
        for path in (*outs, *previews, *denoised) if writes_files else ():
            check_writable(path)
        if checkpoint is not None:
            settings = replace(settings, render=settings.render.but(checkpoint=checkpoint))
            if writes_files:
                CheckpointFile(checkpoint).check(resume=settings.render.resume)
        scene = Scene(description, device_of(settings.render.device))
    scene.load_seconds = time.perf_counter() - start
    if writes_files:
        print_job(job, outs)
    if preview and writes_files:
        hits = first_hit(scene, settings)
        # The last of the three files is the picture, which is written after each pass.
        for path, name in zip(previews, ("albedo", "normal"), strict=False):
            _write_layer(path, name, hits[name])

    rank_options: dict[str, Any] = {} if group is None else {"ranks": group}
    with Bar(_scene_name(job.scene)) as bar:

        def on_progress(state: Any) -> bool:
            # ``done`` and ``total`` count paths. Returning True stops the render.
            bar.update(state.done, state.total, state.rays, state.seconds)
            if preview and writes_files and state.pass_finished and state.done < state.total:
                write_rendered(preview, state.snapshot(), settings.film)
            return interrupt.signum is not None

        rendering = _with_deferred_signals(
            interrupt, lambda: render_scene(scene, settings, on_progress=on_progress, **rank_options)
        )
    if group is not None:  # a signal to one rank stops all; 0: no signal
        interrupt.signum = int(max(group.all_gather_numbers("signals", interrupt.signum or 0))[0]) or None
    if not writes_files:
        return 0 if interrupt.signum is None else Interrupted(interrupt.signum).exit_code
    facts = _write_all([*outs, *((preview,) if preview else ())], denoised, rendering, settings)
    summary = {"out": _one_or_list(outs), **job.facts(), **facts, **rendering.summary()}
    if not rendering.complete:
        summary["complete"] = False
    warn_nonfinite(summary)  # both print warnings, where there are any
    warn_unknown_error(summary)
    summary = plain(summary, digits=6)
    height, width = rendering.image.shape[:2]
    with flushed_stdout():  # one print, as the jobs of a sweep may share stdout; the last line is the summary
        print(f"{sentence(summary, width, height)}\n{json.dumps(summary, allow_nan=False)}")
    record_job(job, summary)  # for the table of a sweep; nothing outside one
    if interrupt.signum is None:
        return 0
    resumable = settings.render.checkpoint is not None and Path(settings.render.checkpoint).exists()
    resume_hint = "; render.resume=true goes on" if resumable else ""
    print(f"torchpt: stopped by a signal; {outs[0]} holds the picture so far{resume_hint}", file=sys.stderr)
    return Interrupted(interrupt.signum).exit_code


def scene_and_settings(job: Job) -> tuple[Any, Any]:
    """Return the scene description and the complete settings of a job; null on the command line unsets the scene's value.

    Raises:
        TorchptError: an invalid scene or setting.
    """
    from torchpt.scene.formats.description import overridden, read_description

    places = () if job.config_dir is None else (Path(job.config_dir, "scene"),)
    return overridden(read_description(job.scene, overrides=job.changes, places=places), job.overrides)


def with_error_pilots(settings: Any) -> Any:
    """Replace ``render.pilots: auto`` by true, so that the summary reports the error."""
    render = settings.render
    with_pilots = render.pilots == "auto"
    return replace(settings, render=render.but(pilots=True)) if with_pilots else settings


def _with_deferred_signals(interrupt: Interrupt, work: Callable[[], Any]) -> Any:
    """Return the result of `work`; from now on a signal does not raise but ends the work early."""
    interrupt.check()
    interrupt.deferred = True
    return work()


def _scene_name(scene: str) -> str:
    """Return the name of a scene, without the folder and ending of its file."""
    path = Path(scene)
    return path.stem if path.suffix in (".yaml", ".yml", ".xml") else path.name


#: Longest side of a picture that libjpeg writes.
_LONGEST_JPEG = 65500


def _check_jpeg(paths: Sequence[str], settings: Any) -> None:
    """Check that pictures are small enough for files that are JPEG.

    Raises:
        SceneError: one is not.
    """
    width, height = settings.film.window[2:]
    for path in paths:
        if Path(path).suffix.lower() in (".jpg", ".jpeg") and max(width, height) > _LONGEST_JPEG:
            key = "film.width" if width > _LONGEST_JPEG else "film.height"
            raise SceneError(key, max(width, height), f"at most {_LONGEST_JPEG} beside {path} (more is no JPEG)")


def _outputs(job: Job, settings: Any) -> list[str]:
    """Return the files to write; refuse ``film.aovs`` of the command line if no file can hold layers.

    Layers that only the scene file asks for are left out in other formats.
    """
    layers = list(settings.film.aovs or ())
    outs = [str(written_path(path, "out")) for path in job.outs]
    if not outs:
        outs = [_scene_name(job.scene) + (".exr" if layers else ".png")]
    if layers and "aovs" in job.overrides.get("film", {}) and not any(_is_exr(path) for path in outs):
        raise SceneError("film.aovs", layers, "a picture ending in .exr among out= (no other format keeps layers)")
    return [numbered(path, job.number) for path in outs]


def check_distinct(files: Sequence[tuple[str, str]]) -> None:
    """Check that no two output paths name the same file, however they are spelled.

    Args:
        files: key and path of each output.

    Raises:
        SceneError: two are the same; names the key and path of the later one, and the file that it would replace.
    """
    key_and_path_of_file: dict[str, tuple[str, str]] = {}
    for key, path in files:
        with suppress(OSError, ValueError):  # an invalid path is reported when it is written
            real_path = os.path.normcase(os.path.realpath(path))
            if real_path in key_and_path_of_file:
                other_key, other_path = key_and_path_of_file[real_path]
                raise SceneError(key, path, f"another file than {other_path!r} of {other_key}")
            key_and_path_of_file[real_path] = key, path


def _is_exr(path: str) -> bool:
    return Path(path).suffix.lower() == ".exr"


def _denoised_files(settings: Any, outs: list[str]) -> list[str]:
    """Return the paths of the denoised pictures, one for each of ``outs``; empty without ``film.denoise``.

    Raises:
        RenderError: the denoiser is not installed.
    """
    if not settings.film.denoise:
        return []
    from torchpt.images.denoiser import check_denoiser
    from torchpt.rendering.result import denoised_path

    check_denoiser()
    return [denoised_path(path) for path in outs]


def _preview_files(preview: str) -> list[str]:
    """Return the files of a preview: albedo, normal and picture."""
    path = Path(preview)
    return [*(str(path.with_name(f"{path.stem}.{name}{path.suffix}")) for name in ("albedo", "normal")), preview]


def _write_all(paths: list[str], denoised: list[str], rendering: Any, settings: Any) -> dict[str, Any]:
    """Write all pictures, then raise the errors of those that failed; return the facts about denoising."""
    from torchpt.rendering.result import denoise_rendering, write_denoised, write_rendered

    failed: list[TorchptError] = []
    facts: dict[str, Any] = {}
    for path in paths:
        try:
            write_rendered(path, rendering, settings.film)
        except OutputError as error:
            elsewhere = _write_elsewhere(path, rendering, settings)
            if elsewhere is not None:
                error = OutputError(path, f"{error.problem}; the picture is in {elsewhere}")
            failed.append(error)
    try:
        if denoised:  # after the rendered pictures are on disk
            facts = {
                "denoised": _one_or_list(denoised),
                "denoise_seconds": round(denoise_rendering(rendering, settings), 4),
            }
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


def _write_elsewhere(path: str, rendering: Any, settings: Any) -> str | None:
    """Write a picture to the home or temporary folder under a new name and return its path, or None if that fails too."""
    from torchpt.rendering.result import write_rendered

    name = Path(path)
    for folder in (os.path.expanduser("~"), tempfile.gettempdir()):
        spare = Path(folder) / f"{name.stem}-{secrets.token_hex(3)}{name.suffix}"
        if Path(folder).is_dir():
            with suppress(OutputError):
                write_rendered(spare, rendering, settings.film)
                return str(spare)
    return None


def _write_layer(path: str, name: str, layer: Any) -> None:
    """Write a layer as a picture; in 8-bit formats normals are mapped from -1..1 to 0..1."""
    from torchpt.images import write_image

    shown = 0.5 * layer + 0.5 if name == "normal" and not _is_exr(path) else layer
    write_image(path, shown, gamma=1.0 if name == "normal" else "srgb")


def _one_or_list(paths: list[str]) -> str | list[str]:
    """Return the paths as the summary shows them: a single one as text, several as a list."""
    return paths[0] if len(paths) == 1 else paths


def sentence(facts: Mapping[str, Any], width: int, height: int) -> str:
    """Return a sentence that sums up a render.

    Args:
        facts: the summary, as printed in JSON.
        width: width of the picture in pixels.
        height: height of the picture in pixels.
    """
    out, spp = facts["out"], facts["spp"]
    text = f"{out if isinstance(out, str) else ', '.join(out)}: {width} x {height} pixels, "
    text += f"{spp} sample{'' if spp == 1 else 's'} a pixel, {two_digits(facts['seconds'])} s"
    if error := error_of(facts):
        text += f"; relative error {error}"
    if denoised := facts.get("denoised"):
        text += f"; denoised: {denoised if isinstance(denoised, str) else ', '.join(denoised)}"
    if not facts.get("complete", True):
        text += "; stopped early"
    elif "stopped_by" in facts:
        text += f"; ended by render.{facts['stopped_by']}"
    return text


def plain(value: Any, digits: int = 17) -> Any:
    """Convert a value for JSON: tensors become lists, NaN and infinity None, floats keep `digits` significant digits."""
    if isinstance(value, dict):
        return {str(key): plain(item, digits) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist(), digits)
    if isinstance(value, list | tuple):
        return [plain(item, digits) for item in value]
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    return value
