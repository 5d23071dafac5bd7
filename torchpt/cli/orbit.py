"""`torchpt orbit`: render a movie in which the camera circles the scene.

Frames are stored in the folder ``OUT.frames`` until the movie is written, so that an interrupted run can resume.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpt.cli import gc_pause
from torchpt.cli.arguments import Arguments
from torchpt.cli.interrupt import Interrupt, Interrupted
from torchpt.cli.notices import print_job, printed_scene_warnings
from torchpt.cli.progress import Bar
from torchpt.cli.render import Job, check_distinct, numbered, plain, scene_and_settings, with_error_pilots
from torchpt.cli.streams import flushed_stdout
from torchpt.cli.sweep_table import record_job
from torchpt.core.errors import OutputError, SceneError
from torchpt.core.files import written_path
from torchpt.core.version import __version__

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from torchpt.scene import Scene
    from torchpt.scene.settings import Settings

__all__ = ["HELP", "Turn", "orbit", "poses", "run"]

HELP = """\
torchpt orbit scene=NAME|FILE.yaml|FILE.xml [out=FILE.gif|FILE.mp4] [frames=48] [degrees=360] [key=value ...]

  Turns the camera about what it looks at (its target, about its up axis; a camera placed by to_world: the middle of the
  scene, about the axis of the scene nearest to its up) and writes the frames as a moving picture.
  scene=    a file ending in .yaml, or a scene that ships:
{scenes}
  out=      .gif, or .mp4 (extra `video`); several as out=[a.gif,a.mp4]; NAME.gif where nothing is said
  frames=   how many; frame k stands at degrees * k / frames                                                48
  degrees=  of the whole turn, counter-clockwise seen from above; negative: the other way around             360
  fps=      frames a second                                                                                 24
  keep=     true: leave the frames where they are, as pictures in OUT.frames                             false
  {keys}
  {changes}

Frame k is what `torchpt render` gives of its camera with render.seed + k. While the run goes on frames lie in OUT.frames;
stopped, the same command takes up where it was. The last line on stdout is a summary in JSON.
Exit codes: 0; 2 bad input; 130 after Ctrl-C and 143 after SIGTERM, with the finished frames kept.
"""
_MOST_FRAMES = 100_000
#: The file in the folder of frames with all that they depend on.
_MANIFEST = "orbit.json"


@dataclass(frozen=True)
class Turn:
    """Settings of the turn.

    Attributes:
        frames: number of frames.
        degrees: angle of the whole turn, counter-clockwise seen from above.
        fps: frames per second.
        keep: keep the frames as pictures after the movie is written.
    """

    frames: int = 48
    degrees: float = 360.0
    fps: float = 24.0
    keep: bool = False

    @classmethod
    def read(cls, words: Mapping[str, str]) -> Turn:
        """Parse the values of the command line, given by key.

        Raises:
            SceneError: an invalid value.
        """
        numbers: dict[str, Any] = {}
        # Of each key: type, what is accepted in words, and the test, which NaN fails.
        for key, kind, expected, accept in (
            ("frames", int, f"a whole number 1..{_MOST_FRAMES}", lambda x: 1 <= x <= _MOST_FRAMES),
            ("degrees", float, "an angle in degrees, at most 1e6 either way", lambda x: abs(x) <= 1e6),
            ("fps", float, "a number 0.01..1000", lambda x: 1e-2 <= x <= 1e3),
        ):
            if key in words:
                try:
                    numbers[key] = kind(words[key])
                except ValueError:
                    numbers[key] = math.nan
                if not accept(numbers[key]):
                    raise SceneError(key, words[key], expected)
        if words.get("keep", "false") not in ("true", "false"):
            raise SceneError("keep", words["keep"], "true or false")
        return cls(**numbers, keep=words.get("keep") == "true")


def poses(scene: Scene, turn: Turn) -> Iterator[NDArray[np.float64]]:
    """Yield the camera-to-world matrix ``(4, 4)`` of every frame; the first is the scene's own."""
    import numpy as np

    from torchpt.math.transforms import look_at, rotate

    camera = scene.description.camera.values
    start = np.asarray(scene.built.parameters["camera.to_world"], np.float64)
    has_target = camera["target"] is not None
    if has_target:
        axis = np.asarray(camera["up"] or (0.0, 1.0, 0.0), np.float64)
        centre = np.asarray(camera["target"], np.float64)
    else:
        nearest = int(np.abs(start[:3, 1]).argmax())  # the axis of the scene that is nearest to the camera's up
        axis, centre = np.sign(start[nearest, 1]) * np.eye(3)[nearest], scene.center()
    for frame in range(turn.frames):
        if frame * turn.degrees % (360.0 * turn.frames) == 0.0:  # whole turns: the scene's own pose, to the bit
            yield start
            continue
        rotation = rotate({"axis": axis.tolist(), "angle": turn.degrees * frame / turn.frames})[:3, :3]
        position = centre + rotation @ ((np.asarray(camera["origin"]) if has_target else start[:3, 3]) - centre)
        if has_target:
            yield look_at(position.tolist(), centre.tolist(), axis.tolist(), key="")  # errors name `target` or `up`
            continue
        pose = start.copy()
        pose[:3, :3], pose[:3, 3] = rotation @ start[:3, :3], position
        yield pose


def run(job: Job, arguments: Arguments, interrupt: Interrupt) -> int:
    """Run `torchpt orbit` for one job and return the exit code."""
    return orbit(job, Turn.read(arguments.turn), interrupt)


def orbit(job: Job, turn: Turn, interrupt: Interrupt) -> int:
    """Render the missing frames, write the movie, print the summary and return the exit code.

    Raises:
        TorchptError: bad input, a folder with frames of other settings, or a file that cannot be written.
        Interrupted: a signal arrived before the first frame.
    """
    from torchpt.images.movie import check_movie, write_movie
    from torchpt.scene.devices import device_of
    from torchpt.scene.scene import Scene
    from torchpt.scene.settings import MAX_SEED

    gc_pause.resume()  # the imports are done: collect garbage again
    start = time.perf_counter()
    with printed_scene_warnings():
        description, run_settings = scene_and_settings(job)
        for group, key in (
            ("render", "preview"),
            ("render", "checkpoint"),
            ("film", "aovs"),
            ("film", "denoise"),
        ):
            if job.overrides.get(group, {}).get(key):
                what = "nothing: torchpt orbit writes frames only"
                if key == "denoise":
                    what = "false: torchpt orbit writes frames as rendered (denoised one by one they flicker)"
                raise SceneError(f"{group}.{key}", job.overrides[group][key], what)
        if run_settings.render.seed > (last := MAX_SEED - turn.frames + 1):
            expected = f"a whole number 0..{last} where frames={turn.frames} (frame k has the seed render.seed + k)"
            raise SceneError("render.seed", run_settings.render.seed, expected)
        outs = _outputs(job)
        check_distinct([("out", path) for path in outs])
        for path in outs:
            check_movie(path, turn.fps)
        scene = Scene(description, device_of(run_settings.render.device))
        frames = Frames(Path(f"{outs[0]}.frames"), _frame_dependencies(scene, run_settings, turn))
        already_rendered = frames.count(turn.frames)
    load_seconds = time.perf_counter() - start
    print_job(job, outs)
    interrupt.check()
    interrupt.deferred = True  # from here on a signal ends the run after a chunk, and raises nothing
    totals = _render_missing_frames(job, scene, turn, frames, interrupt)
    ready = frames.count(turn.frames)
    facts: dict[str, Any] = {
        "out": outs[0] if len(outs) == 1 else outs,
        **job.facts(),
        "frames": turn.frames,
        "rendered": ready - already_rendered,
    }
    facts |= {"load_seconds": round(load_seconds, 4), **totals}
    if ready == turn.frames:
        for path in outs:
            write_movie(path, frames.pictures(turn.frames), turn.fps)
        if not turn.keep:
            frames.remove(turn.frames)
    else:
        facts["complete"] = False
    facts["seconds"] = round(time.perf_counter() - start, 4)
    with flushed_stdout():
        print(json.dumps(plain(facts), allow_nan=False))
    record_job(job, facts)  # for the table of a sweep; nothing outside one
    if interrupt.signum is None:
        return 0
    kept = (
        f"{outs[0]} is written" if ready == turn.frames else f"{ready} of {turn.frames} frames are in {frames.folder}"
    )
    print(f"torchpt: stopped by a signal; {kept}", file=sys.stderr)
    return Interrupted(interrupt.signum).exit_code


def _outputs(job: Job) -> list[str]:
    """Return the movies to write; in a sweep their names have the job's number."""
    path = Path(job.scene)
    name = path.stem if path.suffix in (".yaml", ".yml", ".xml") else path.name
    return [numbered(str(written_path(out, "out")), job.number) for out in job.outs or (f"{name}.gif",)]


def _render_missing_frames(job: Job, scene: Scene, turn: Turn, frames: Frames, interrupt: Interrupt) -> dict[str, Any]:
    """Render the missing frames until a signal arrives; return their total rays and non-finite samples."""
    import torch

    from torchpt.rendering.api import render_scene
    from torchpt.scene.formats.description import settings

    own_pose, seed = scene.raw_params["camera.to_world"], settings(scene.description, job.overrides).render.seed
    totals: dict[str, int] = {"rays": 0, "nonfinite_samples": 0}
    causes: Counter[str] = Counter()
    begun = time.perf_counter()
    with Bar(frames.folder.stem) as bar:

        def on_progress(number: int, rays: int, state: Any) -> bool:
            done, seconds = number * state.total + state.done, time.perf_counter() - begun
            bar.update(done, turn.frames * state.total, rays + state.rays, seconds)
            return interrupt.signum is not None

        for number, pose in enumerate(poses(scene, turn)):
            if interrupt.signum is not None:
                break
            if frames.has(number):
                continue
            frame_overrides = {**job.overrides, "render": {**job.overrides.get("render", {}), "seed": seed + number}}
            run_settings = with_error_pilots(settings(scene.description, frame_overrides))  # as `torchpt render`
            # In a scene file these settings are meant for `torchpt render`.
            film, render = run_settings.film.but(denoise=False), run_settings.render.but(checkpoint=None, resume=False)
            run_settings = replace(run_settings, film=film, render=render)
            scene.replace_params({"camera.to_world": torch.from_numpy(pose.copy()).to(own_pose)})
            rendering = render_scene(scene, run_settings, on_progress=partial(on_progress, number, totals["rays"]))
            if not rendering.complete:
                break
            frames.write(number, rendering.image, run_settings.film)
            summary = rendering.summary()
            totals = {name: count + summary[name] for name, count in totals.items()}
            causes.update(summary.get("nonfinite_causes", {}))
    return {**totals, "nonfinite_causes": dict(causes)} if causes else totals


class Frames:
    """The folder of the frames, with a manifest of the settings that they were rendered with.

    Args:
        folder: the folder; it is created if missing.
        facts: everything that the frames depend on, by dotted name.

    Raises:
        OutputError: the folder holds other files or frames of other settings, or cannot be created.
    """

    def __init__(self, folder: Path, facts: dict[str, Any]) -> None:
        self.folder = folder
        manifest = folder / _MANIFEST
        try:
            if not folder.exists():
                folder.mkdir()
            if not manifest.exists():
                if any(folder.iterdir()):
                    raise OutputError(folder, f"is in the way: it holds no {_MANIFEST}, so it is no folder of frames")
                unfinished = folder / f".{_MANIFEST}"
                unfinished.write_text(json.dumps(facts, indent=1))
                unfinished.replace(manifest)
            known = json.loads(manifest.read_text())
        except ValueError:
            raise OutputError(folder, f"{_MANIFEST} is malformed; remove the folder to begin anew") from None
        except OSError as error:
            raise OutputError(folder, f"cannot be used for frames ({error.strerror or error})") from None
        facts = json.loads(json.dumps(facts))
        if known != facts:
            known = known if isinstance(known, dict) else {}
            name = next(name for name in (*facts, *known) if known.get(name, ...) != facts.get(name, ...))
            other = f"{name} {known.get(name)}, now {facts.get(name)}" if name != "scene" else "the scene was another"
            how = "remove it to begin anew, or give another out="
            raise OutputError(folder, f"holds frames of other settings ({other}); {how}")

    def file(self, number: int) -> Path:
        """Return the path of a frame."""
        return self.folder / f"{number:06d}.png"

    def has(self, number: int) -> bool:
        """Return True if a frame exists. Frames are written atomically, so it is complete."""
        return self.file(number).exists()

    def count(self, frames: int) -> int:
        """Count the existing frames among the first `frames`."""
        return sum(map(self.has, range(frames)))

    def write(self, number: int, image: Any, film: Any) -> None:
        """Write a frame with the display settings of `film`."""
        from torchpt.images import write_image

        write_image(self.file(number), image, exposure=film.exposure, tonemap=film.tonemap, gamma=film.gamma)

    def pictures(self, frames: int) -> Iterator[Any]:
        """Yield the frames ``(H, W, 3)`` uint8 in order."""
        from torchpt.images import read_texels

        for number in range(frames):
            values = read_texels(self.file(number)).values  # whole numbers over 255
            yield (values[..., :3] * 255.0 + 0.5).astype("uint8")

    def remove(self, frames: int) -> None:
        """Delete the frames and the manifest, and the folder if it is empty then."""
        with suppress(OSError):
            for number in range(frames):
                self.file(number).unlink(missing_ok=True)
            (self.folder / _MANIFEST).unlink()
            self.folder.rmdir()


def _frame_dependencies(scene: Scene, run_settings: Settings, turn: Turn) -> dict[str, Any]:
    """Return everything that frames depend on, by dotted name: the turn, the settings, a hash of the scene."""
    from torchpt.scene.fingerprint import fingerprint
    from torchpt.scene.settings import settings_with
    from torchpt.spec import Role

    facts = {"torchpt": __version__, "frames": turn.frames, "degrees": turn.degrees}
    without = {"render": settings_with(Role.FREE, but=Role.ENDS)["render"]}  # settings that do not change a frame
    return {**facts, **dict(_dotted(run_settings.plain(without=without))), "scene": fingerprint(scene)}


def _dotted(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested mappings with their dotted names."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
