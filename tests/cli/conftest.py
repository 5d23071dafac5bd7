"""A command line whose renderer is a stand-in: these tests are about words, files and exit codes, not about light."""

from __future__ import annotations

import sys
import types
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import torch

SCENE = """\
camera: {type: perspective, origin: [0, 0, -4], target: [0, 0, 0]}
film: {width: 8, height: 6}
integrator: {clamp: 10}
render: {spp: 4}
shapes: {ball: {type: sphere, center: [0, 0, 0], radius: 1}}
"""


@dataclass
class Rendering:
    settings: Any
    done: int
    total: int
    denoised: torch.Tensor | None = None
    write_seconds: float = 0.0

    @property
    def complete(self) -> bool:
        return self.done >= self.total

    @property
    def image(self) -> torch.Tensor:
        return torch.full((self.settings.film.height, self.settings.film.width, 3), self.done / self.total)

    @property
    def layers(self) -> dict[str, torch.Tensor]:
        return {name: self.image for name in self.settings.film.aovs}

    @property
    def guides(self) -> dict[str, torch.Tensor]:
        return {name: self.image for name in ("albedo", "normal")} if self.settings.film.denoise else {}

    def header(self) -> dict[str, Any]:
        return {"spp": self.done, "relmse": 0.125, "relmse_low": 0.0625}

    def summary(self) -> dict[str, Any]:
        facts = {
            "spp": self.done,
            "load_seconds": 0.25,
            "seconds": 1.5,
            "paths_per_second": 2e6,
            "rays": 77,
            "nonfinite_samples": 0,
        }
        return {**facts, "mean": self.image.mean((0, 1)), "relmse": float("nan")}


@dataclass
class Progress:
    done: int
    total: int
    snapshot: Callable[[], Rendering]
    pass_finished: bool = True
    rays: int = 5
    seconds: float = 0.5


@dataclass
class Renderer:
    """What was rendered with which settings, and what happens after each pass."""

    settings: list[Any] = field(default_factory=list)
    after_pass: Callable[[int], None] = lambda done: None

    def render_scene(self, scene: object, settings: Any, on_progress: Callable[[Progress], bool]) -> Rendering:
        self.settings.append(settings)
        total = settings.render.spp
        for done in range(1, total + 1):
            self.after_pass(done)
            now = Rendering(settings, done, total)
            if on_progress(Progress(done, total, lambda now=now: now)):
                return now
        return Rendering(settings, total, total)

    def first_hit(self, scene: object, settings: Any) -> dict[str, torch.Tensor]:
        shape = (settings.film.height, settings.film.width, 3)
        return {"albedo": torch.full(shape, 0.5), "normal": torch.tensor([0.0, 0.0, 1.0]).expand(shape)}


@pytest.fixture
def renderer(monkeypatch: pytest.MonkeyPatch) -> Renderer:
    stand_in = Renderer()
    module: Any = types.ModuleType("torchpt.rendering.api")
    module.render_scene, module.first_hit = stand_in.render_scene, stand_in.first_hit
    monkeypatch.setitem(sys.modules, "torchpt.rendering.api", module)
    return stand_in


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder: it holds a scene file, ``s.yaml``."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.yaml").write_text(SCENE)
    return tmp_path
