"""`torchpt stress`: run extreme cases, print their errors as a table or JSON, and plot the sweeps."""

from __future__ import annotations

import fnmatch
import json
import time
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpt.cli import gc_pause
from torchpt.cli.arguments import GROUPS, UsageError, is_scene_word
from torchpt.cli.interrupt import Interrupt
from torchpt.cli.streams import flushed_stdout
from torchpt.core.errors import OutputError, SceneError
from torchpt.core.files import written_path

if TYPE_CHECKING:
    from torchpt.stress import Case, Harness, Outcome

__all__ = ["HELP", "run"]

HELP = """\
torchpt stress [quick=true] [case=PATTERN] [out=FOLDER] [key=value|key=[a,b] ...]
torchpt stress scene=NAME|FILE.yaml|FILE.xml [key=value ...]

  What breaks path tracers, measured against closed forms and float64: roughness, index, albedo, sizes, distances, radiance,
  lights and path lengths swept over all that float32 holds. With scene= the same of a scene of yours: moved, scaled, turned,
  in float64 and by every search it has to be the same picture.
  quick=    true: a few places of each sweep                                    false
  case=     names of cases or topics, with * and ?: case=*glass*, case=places   all
  device=   cpu, cuda, cuda:N                                                   cpu
  accel=    auto, numba, torch, brute, or a list of them                        auto
  compile=  auto, on, off, or a list of them                                    auto
  dtype=    float32 or float64                                                  float32
  camera.fov=20, +shapes.NAME=..., ~lights.NAME: any key of the scene, as in torchpt render
  out=      a folder for stress.json, stress.md and pictures of the sweeps      none
  --json    the figures as one JSON object in place of the table

Exit codes: 0 all passed; 1 some failed; 2 bad input.
"""
#: Values that a key accepts, the default first.
_CHOICES = {
    "accel": ("auto", "numba", "torch", "brute"),
    "compile": ("auto", "on", "off"),
    "dtype": ("float32", "float64"),
    "quick": ("false", "true"),
}
_KEYS = ("quick", "case", "device", "accel", "compile", "dtype", "out", "scene")


@dataclass
class StressOptions:
    """The parsed arguments of ``torchpt stress``.

    Attributes:
        text_of_key: values of the keys in ``_KEYS``, as written.
        settings: settings of the scene, by block and key.
        changes: overrides of scene keys.
        json: print JSON.
    """

    text_of_key: dict[str, str] = field(default_factory=dict)
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    changes: dict[str, Any] = field(default_factory=dict)
    json: bool = False

    @classmethod
    def read(cls, words: list[str]) -> StressOptions:
        """Parse the words after ``stress``.

        Raises:
            UsageError: an unknown word.
            SceneError: an invalid value.
        """
        import yaml

        found = cls()
        for word in words:
            key, equals, value = word.partition("=")
            group, dot, name = key.partition(".")
            if word == "--json":
                found.json = True
            elif is_scene_word(word):
                found.add_change(word)
            elif equals and key in _KEYS:
                if key in found.text_of_key:
                    raise UsageError(f"{key}: given twice")
                found.text_of_key[key] = value
            elif equals and dot and group in GROUPS:
                try:
                    found.settings.setdefault(group, {})[name] = yaml.safe_load(value)
                except yaml.YAMLError:
                    raise UsageError(f"{word}: the value cannot be read") from None
            else:
                raise UsageError(f"{word}: expected one of {', '.join(f'{k}=' for k in _KEYS)}, --json or --help")
        if (found.settings or found.changes) and "scene" not in found.text_of_key:
            first = next(iter([*found.settings, *found.changes]))
            raise UsageError(f"{first}: settings are of a scene: expected scene= beside them")
        for group in ("film", "render"):
            for name, value in found.settings.get(group, {}).items():
                raise UsageError(
                    f"{group}.{name}: expected none of film and render, which `torchpt stress` sets itself, got {value!r}; "
                    "accel= and compile= say what is compared"
                )
        for key, accepted in _CHOICES.items():
            values = found.list(key, accepted[0])
            takes_one = key in ("dtype", "quick")
            if not set(values) <= set(accepted) or (takes_one and len(values) > 1):
                raise SceneError(key, found.text_of_key[key], f"one of {', '.join(accepted)}")
        return found

    def add_change(self, word: str) -> None:
        """Add an override of a scene key."""
        from torchpt.cli.grammar import read_word

        key, values, sweeps = read_word(word)
        if sweeps or key in self.changes:
            raise UsageError(f"{key}: expected one value, got {word!r}" if sweeps else f"{key}: given twice")
        self.changes[key] = values[0]

    def list(self, key: str, default: str) -> list[str]:
        """Return the values of a key: those of a list ``[a,b]``, or the single value."""
        text = self.text_of_key.get(key, default)
        return [part.strip() for part in text[1:-1].split(",")] if text[:1] == "[" and text[-1:] == "]" else [text]


def run(words: list[str], interrupt: Interrupt) -> int:
    """Run the selected cases, print the result of each and return the exit code.

    Raises:
        TorchptError: bad input.
    """
    options = StressOptions.read(words)
    from torchpt.stress.outcome import outcome_of
    from torchpt.stress.table import facts, heading, line

    gc_pause.resume()  # the imports are done: collect garbage again
    topics, harnesses, folder = _topics(options), _harnesses(options), _folder(options)
    quick, start = options.text_of_key.get("quick") == "true", time.perf_counter()
    outcomes: dict[str, dict[str, list[Outcome]]] = {}  # by label of the harness and topic
    for number, (label, harness) in enumerate(harnesses.items()):
        _print_unless_json(options, f"{label}\n{heading()}")
        for topic, cases in topics.items():
            for case in cases:
                if number and not case.uses_backend:  # the first run is enough
                    continue
                outcome = outcome_of(case, harness, quick=quick)
                outcomes.setdefault(label, {}).setdefault(topic, []).append(outcome)
                _print_unless_json(options, line(outcome))
    flat = [outcome for by_topic in outcomes.values() for row in by_topic.values() for outcome in row]
    failed, refused = sum(not outcome.passed for outcome in flat), sum(outcome.refusals > 0 for outcome in flat)
    results = {
        "cases": len(flat),
        "failed": failed,
        "refused": refused,
        "seconds": round(time.perf_counter() - start, 1),
        "runs": {label: facts(by_topic) for label, by_topic in outcomes.items()},
    }
    if folder is not None:
        _write_results(folder, results, outcomes)
    refused_text = f", {refused} refused wholly or in part by the search" if refused else ""
    _print_unless_json(options, f"{len(flat)} cases, {failed} failed{refused_text}")
    if options.json:
        with flushed_stdout():
            print(json.dumps(results, allow_nan=False))
    return 1 if failed else 0


def _print_unless_json(options: StressOptions, text: str) -> None:
    if not options.json:
        with flushed_stdout():
            print(text)


def _harnesses(options: StressOptions) -> dict[str, Harness]:
    """Return a harness for each combination of ``accel=`` and ``compile=``, by label."""
    import torch

    from torchpt.scene.devices import device_of
    from torchpt.stress import Harness

    device, dtype = options.text_of_key.get("device", "cpu"), options.text_of_key.get("dtype", "float32")
    if not (device in ("cpu", "cuda") or (device.startswith("cuda:") and device[5:].isdigit())):
        raise SceneError("device", device, "cpu, cuda or cuda:N")
    device_of(device)  # raises where it is not available
    if "on" in options.list("compile", "auto") and (device, dtype) != ("cpu", "float32"):
        raise SceneError("compile", "on", f"auto or off (there are no kernels for {dtype} on {device})")
    return {
        f"accel {accel}, compile {compiled}, {dtype} on {device}": Harness(
            device=device, accel=accel, compile=compiled, dtype=getattr(torch, dtype)
        )
        for accel, compiled in product(options.list("accel", "auto"), options.list("compile", "auto"))
    }


def _topics(options: StressOptions) -> dict[str, tuple[Case, ...]]:
    """Return the selected cases by topic."""
    from torchpt.stress.cases import all_cases
    from torchpt.stress.scene_cases import cases_of

    scene = options.text_of_key.get("scene")
    cases_of_topic = all_cases() if scene is None else {"scene": cases_of(scene, options.settings, options.changes)}
    pattern = options.text_of_key.get("case", "*")
    found = {
        topic: tuple(one for one in cases if fnmatch.fnmatch(one.name, pattern) or fnmatch.fnmatch(topic, pattern))
        for topic, cases in cases_of_topic.items()
    }
    if not any(found.values()):
        raise SceneError("case", pattern, f"a topic ({', '.join(cases_of_topic)}) or a case, with * and ?")
    return found


def _folder(options: StressOptions) -> Path | None:
    """Return the folder of ``out=``, which is made if it is missing; None without."""
    if "out" not in options.text_of_key:
        return None
    folder = written_path(options.text_of_key["out"], "out")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(folder, f"cannot be made ({error.strerror or error})") from None
    return folder


def _write_results(folder: Path, results: dict[str, Any], outcomes: dict[str, dict[str, list[Outcome]]]) -> None:
    """Write the figures, the table, and a picture of each topic by the first backend."""
    from torchpt.reports.runs import write_whole
    from torchpt.stress.plots import draw
    from torchpt.stress.table import markdown

    write_whole(folder / "stress.json", json.dumps(results, indent=1, allow_nan=False).encode())
    pages = [f"### {label}\n\n{markdown(by_topic)}\n" for label, by_topic in outcomes.items()]
    write_whole(folder / "stress.md", "\n".join(pages).encode())
    for topic, topic_outcomes in next(iter(outcomes.values())).items():
        draw(topic_outcomes, folder / f"{topic}.svg")
