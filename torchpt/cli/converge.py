"""`torchpt converge`: run a convergence study, write its report and print a summary in JSON."""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any

from torchpt.cli import gc_pause, keys
from torchpt.cli.arguments import UsageError, parse_study
from torchpt.cli.interrupt import Interrupt, Interrupted
from torchpt.cli.notices import printed_scene_warnings
from torchpt.cli.progress import Bar
from torchpt.cli.streams import flushed_stdout
from torchpt.core.errors import OutputError, SceneError
from torchpt.core.files import written_path

__all__ = ["HELP", "converge", "raw_study", "run"]

#: File in the output folder with all that the study's runs depend on, by which the same study is known again.
_STUDY_FILE = "study.json"
#: Keys that change how the report shows the runs, not the runs.
_PRESENTATION_KEYS = ("title", "metrics", "target", "extra")

HELP = """\
torchpt converge scene=NAME|[A,B] [out=FOLDER] [key=value|key=[a,b] ...]
torchpt converge study=NAME|FILE.yaml [key=value ...]

  Error against run time: several independent runs of every combination of settings at growing samples a pixel, each timed
  without set-up, compared with a reference. A list makes an axis of the grid: sampler=[independent,sobol].
  scene=      a file ending in .yaml or .xml, or a scene that ships, or a list of them:
{scenes}
  out=        the folder of report.html, report.json, plots/ and runs/; where nothing is said SCENE_converge, or, where
              that holds another study, SCENE_converge_2, ...
  study=      a YAML file with the same keys, or a study that ships (samplers); words of the command line win over it
  spp=        samples a pixel of each step                                                   [4,16,64,256]
  seeds=      independent runs of each step                                                  5
  seed=       the seeds of all runs follow from it                                           0
  reference=  a linear picture such as ref.exr; else it is made of independent runs:
              reference.spp=, reference.seeds=, reference.KEY= for its settings              4 times the largest step, 8
  metrics=    of relmse relmse_trimmed mse smape psnr ssim flip; curves show the first       all
  target=     errors whose times are told, such as [0.01,0.001]                              one that all curves reach
  extra=      others' pictures beside ours: [{{name: theirs, seconds: 12.5, file: theirs.exr}}]
  denoise=    true: beside every curve a second one, of its runs' denoised pictures            false
  title=      of the page
  {keys}
  {changes}
              several values make an axis as well: camera.fov=20,40; a list is one value
  overrides=  of a study file: keys of the scene, as above: overrides: {{camera.fov: '20,40'}}         none

A study that was stopped resumes: the same command takes up the runs that are in FOLDER/runs. The last line on stdout is a
summary in JSON. Exit codes: 0; 2 bad input; 130 after Ctrl-C and 143 after SIGTERM, with the finished runs kept.
"""


def run(words: list[str], interrupt: Interrupt) -> int:
    """Run the study that the words after ``converge`` describe and return the exit code."""
    study, changes = parse_study(words)
    if not {"scene", "study"} & study.keys():
        ship = ", ".join(keys.options("scene"))
        raise UsageError(f"scene: expected scene=NAME, scene=FILE.yaml or study=FILE.yaml; scenes that ship: {ship}")
    return converge(study, changes, interrupt)


def raw_study(words: Mapping[str, str], changes: Sequence[str] = ()) -> tuple[dict[str, Any], str | None]:
    """Merge a study file and the command line: return the values by key, and the file (None without ``study=``).

    Args:
        words: values of the command line by key; they win over the file's.
        changes: overrides of scene keys; several values of one are an axis of the study.

    Raises:
        TorchptError: a file or value that cannot be read.
    """
    from torchpt.reports.study import read_study

    raw, file = read_study(words["study"]) if "study" in words else ({}, None)
    for key, text in words.items():
        if key == "study":
            continue
        if key == "scene":
            value: Any = _scene_names(text)
        elif key == "title" or (key == "reference" and not text.startswith("{")):
            value = text  # a file name may contain characters that YAML interprets
        else:
            value = _parse_value(key, text)
        head, _, name = key.partition(".")
        if head == "reference" and name:
            before = raw.get("reference")
            raw["reference"] = {**(before if isinstance(before, Mapping) else {}), name: value}
        else:
            raw[key] = value
    if changes or "overrides" in raw:
        raw["overrides"] = _file_overrides(raw.get("overrides") or {}, file) | _command_line_overrides(changes)
    return raw, file


def _file_overrides(written: Any, file: str | None) -> dict[str, list[Any]]:
    """Return the values of a study file's ``overrides`` by key; text is parsed as on the command line (``a,b``: two values)."""
    from torchpt.cli.grammar import read_value

    if not isinstance(written, Mapping):
        raise SceneError("overrides", written, "a mapping from keys of scenes such as camera.fov to values", file)
    return {
        str(key): read_value(str(key), value)[0] if isinstance(value, str) else [value]
        for key, value in written.items()
    }


def _command_line_overrides(words: Sequence[str]) -> dict[str, list[Any]]:
    """Parse overrides of the command line: values by key."""
    found: dict[str, list[Any]] = {}
    for word in words:
        from torchpt.cli.grammar import read_word

        key, values, _ = read_word(word)
        if key in found:
            raise UsageError(f"{key}: given twice")
        found[key] = values
    return found


def _parse_value(key: str, text: str) -> Any:
    """Parse a value as YAML."""
    from torchpt.scene.formats.yaml import parse_yaml, plain

    try:
        parsed = parse_yaml(text)
    except SceneError:
        raise SceneError(key, text, "a value, or a list [a,b] of values (quote text that holds marks)") from None
    return plain({key: parsed})[key]


def _scene_names(text: str) -> list[str]:
    """Return the scenes of ``scene=``: one name or file, or a list in brackets."""
    if Path(text).exists() or not (text.startswith("[") and text.endswith("]")):
        return [text]
    return [name.strip().strip("'\"") for name in text[1:-1].split(",")]


def converge(words: Mapping[str, str], changes: Sequence[str], interrupt: Interrupt) -> int:
    """Render the missing runs of a study, write the report, print the summary and return the exit code.

    Args:
        words: values of the command line by key.
        changes: overrides of scene keys.
        interrupt: the signal handler.

    Raises:
        TorchptError: bad input, found before anything is rendered.
        Interrupted: a signal arrived before the first run.
    """
    from torchpt.reports.analysis import check_files
    from torchpt.reports.report import plain, write_report
    from torchpt.reports.runs import Stopped, Store, measure, prepare, write_whole
    from torchpt.reports.study import study_of

    gc_pause.resume()  # the imports are done: collect garbage again
    start = time.perf_counter()
    raw, file = raw_study({key: text for key, text in words.items() if key != "out"}, changes)
    with printed_scene_warnings():
        study = study_of(raw, file)
        identity = _study_identity(raw, study.options)
        folder, note = _output_folder(words.get("out"), f"{_default_stem(study.scenes, file)}_converge", identity)
        prepared = prepare(study)
        check_files(study, prepared)
        store = Store(folder / "runs")
        write_whole(folder / _STUDY_FILE, json.dumps(identity, indent=1).encode())
    if note:
        print(f"torchpt: {note}", file=sys.stderr)
    interrupt.check()
    interrupt.deferred = True  # from here on a signal ends the study after a run, and raises nothing
    with Bar(folder.name, lines=True) as bar:

        def on_progress(done: int, total: int, rays: int, seconds: float) -> bool:
            bar.update(done, total, rays, seconds)
            return interrupt.signum is not None

        try:
            measure(study, prepared, store, on_progress)
        except Stopped as stopped:
            print(
                f"torchpt: stopped by a signal; {stopped.done} of {stopped.total} runs are in {store.folder}, and the same "
                "command takes up there",
                file=sys.stderr,
            )
            return Interrupted(interrupt.signum or signal.SIGINT).exit_code
    scene_reports = write_report(study, prepared, folder)
    facts = {
        "out": str(folder / "report.html"),
        "seconds": round(time.perf_counter() - start, 4),
        "scenes": [
            {
                "scene": scene_report.name,
                "curves": [
                    {
                        "label": line.label,
                        "denoised": line.denoised_from is not None,
                        "slope": line.by_spp.slope.mean if line.by_spp else None,
                        "times": line.times,
                        "biased": line.bias["biased"] if line.bias else None,
                        "nonfinite_samples": sum(step.nonfinite for step in line.steps),
                    }
                    for line in scene_report.lines
                ],
            }
            for scene_report in scene_reports
        ],
    }
    with flushed_stdout():
        print(json.dumps(plain(facts), allow_nan=False))
    return 0 if interrupt.signum is None else Interrupted(interrupt.signum).exit_code


def _output_folder(out: str | None, name: str, identity: dict[str, Any]) -> tuple[Path, str]:
    """Return the output folder of a study, and a message if that or the default folder holds another study.

    Args:
        out: value of ``out=``, or None.
        name: default folder; if it holds another study, ``NAME_2``, ``NAME_3``, ... are tried.
        identity: result of :func:`_study_identity`.

    Raises:
        OutputError: the path is a file.
    """
    first = written_path(name if out is None else out, "out")
    if first.exists() and not first.is_dir():
        raise OutputError(first, "is a file; expected a folder")
    if not _holds_another(first, identity):
        return first, ""
    if out is not None:
        return first, f"{first} holds the report of another study, which this one's replaces; its runs stay"
    numbered_folders = (first.with_name(f"{first.name}_{number}") for number in count(2))
    folder = next(path for path in numbered_folders if not _holds_another(path, identity))
    return folder, f"{first} holds another study; this one is in {folder} (out= names another folder)"


def _holds_another(folder: Path, identity: dict[str, Any]) -> bool:
    """Return True if a folder holds another study. One with fewer steps or seeds, else equal, is the same: it is continued."""
    study_file = folder / _STUDY_FILE
    if not study_file.exists():
        return (folder / "report.html").exists() or (folder.exists() and not folder.is_dir())
    try:
        known_identity = json.loads(study_file.read_text(encoding="utf-8"))
        has_same_or_more_steps = (
            set(known_identity["spp"]) <= set(identity["spp"]) and known_identity["seeds"] <= identity["seeds"]
        )
    except (OSError, ValueError, KeyError, TypeError):  # not written by torchpt
        return True
    return {**known_identity, "spp": 0, "seeds": 0} != {**identity, "spp": 0, "seeds": 0} or not has_same_or_more_steps


def _study_identity(raw: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return everything that the runs of a study depend on, as values for JSON.

    Args:
        raw: keys of the study as written.
        options: parsed keys of the study, see :class:`torchpt.reports.study.Study`.
    """
    from torchpt.reports.report import plain

    identity = {key: value for key, value in raw.items() if key not in _PRESENTATION_KEYS}
    return json.loads(json.dumps(plain({**identity, "spp": options["spp"], "seeds": options["seeds"]}), sort_keys=True))


def _default_stem(scenes: tuple[str, ...], file: str | None) -> str:
    """Return the start of the output folder's name: that of the study file, else those of the scenes."""
    if file is not None:
        return Path(file).stem
    return "_".join(Path(name).stem if name.endswith((".yaml", ".yml", ".xml")) else name for name in scenes)
