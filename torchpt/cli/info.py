"""`torchpt info`: print what a scene holds, which tables were built for it, and what was left out and why."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from torchpt.cli import gc_pause
from torchpt.cli.arguments import Arguments
from torchpt.cli.interrupt import Interrupt
from torchpt.cli.notices import print_job, printed_scene_warnings
from torchpt.cli.render import Job, plain, scene_and_settings, with_error_pilots
from torchpt.cli.streams import flushed_stdout
from torchpt.core.errors import TorchptError

__all__ = ["HELP", "info", "lines", "run"]

HELP = """\
torchpt info scene=NAME|FILE.yaml|FILE.xml [--json] [key=value ...]

  What the scene holds, what was built for it, and what was left out because nothing needs it.
  scene=   a file ending in .yaml or .xml (Mitsuba), or a scene that ships:
{scenes}
  {keys}
  {changes}
"""


def run(job: Job, arguments: Arguments, interrupt: Interrupt) -> int:
    """Run `torchpt info` for one job and return the exit code."""
    return info(job, interrupt, as_json=arguments.json)


def info(job: Job, interrupt: Interrupt, *, as_json: bool = False) -> int:
    """Load and build a scene, print its facts and return the exit code.

    Raises:
        TorchptError: bad input.
        Interrupted: a signal arrived.
    """
    from torchpt.rendering import describe_engine
    from torchpt.scene.devices import device_of
    from torchpt.scene.scene import Scene

    gc_pause.resume()  # the imports are done: collect garbage again
    with printed_scene_warnings():
        description, settings = scene_and_settings(job)
        scene = Scene(description, device_of(settings.render.device))
        facts = scene.info(settings)
        facts["built"]["loop"] = describe_engine(scene, settings)
        facts = {**job.facts(), **facts}
        if settings.render.max_memory is not None:
            facts["memory"] = _memory_facts(scene, settings)
    print_job(job)
    interrupt.check()
    if "refused" in facts.get("memory", ()):
        print(f"torchpt: warning: no render could run: {facts['memory']['refused']}", file=sys.stderr)
    with flushed_stdout():
        if not as_json:
            facts["left_out"] = f"{len(facts['left_out'])} features that this scene does not need (--json lists them)"
        if as_json:
            print(json.dumps(plain(facts), allow_nan=False))
        elif not sys.stdout.isatty():
            print("\n".join(key + value for key, value in lines(facts)))
        else:
            from rich.console import Console
            from rich.text import Text

            for key, value in lines(facts):
                Console().print(Text(key, style="bold") + Text(value), soft_wrap=True)
    return 0


def _memory_facts(scene: Any, settings: Any) -> dict[str, Any]:
    """Return whether ``render.max_memory`` suffices for a render, and the error message if it does not."""
    import torch

    from torchpt.rendering import Run

    settings = with_error_pilots(settings)  # as `torchpt render`
    settings = replace(settings, render=settings.render.but(checkpoint=None, resume=False))
    try:
        with torch.no_grad():
            Run(scene, settings, params=None, dtype=torch.float32)  # is not started: this checks the memory limit
    except TorchptError as error:
        return {"enough": False, "refused": str(error)}
    return {"enough": True}


def lines(facts: dict[str, Any], depth: int = 0) -> Iterator[tuple[str, str]]:
    """Yield a nested dict as indented lines, each a pair ``("  key:", " value")``."""
    pad = "  " * depth
    for key, value in facts.items():
        if isinstance(value, dict) and value:
            yield f"{pad}{key}:", ""
            yield from lines(value, depth + 1)
        elif isinstance(value, list | tuple) and any(isinstance(item, dict | str) for item in value):
            yield f"{pad}{key}:", ""
            for item in value:
                if isinstance(item, dict):
                    yield f"{pad}  - ", ", ".join(f"{name}: {_format_value(part)}" for name, part in item.items())
                else:
                    yield f"{pad}  - ", _format_value(item)
        else:
            yield f"{pad}{key}:", f" {_format_value(value)}"


def _format_value(value: Any) -> str:
    """Return a value as a reader sees it: yes and no, thousands with commas, six digits."""
    value = plain(value)
    if value is None or value == {} or value == []:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return ", ".join(_format_value(item) for item in value)
    return str(value)
