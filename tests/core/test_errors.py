"""Errors that are made of a message alone, as torch raises those of its workers again."""

from __future__ import annotations

import pickle

import pytest

import torchpt
from torchpt.core.errors import ArgumentTypeError, ArgumentValueError, TorchptError

ERRORS = [
    torchpt.SceneError("a.b", 3, "2"),
    torchpt.SceneError("a.b", 3, "2", "scene.yaml"),
    torchpt.NotBuiltError("a.b", "x", "y"),
    ArgumentTypeError("faces", 3, "a tensor"),
    ArgumentValueError("faces", 3, "4"),
    torchpt.AssetError("a.obj", "no such file"),
    torchpt.OutputError("a.exr", "cannot be written"),
    torchpt.RenderError("lost"),
    torchpt.OtherRankError("lost", 3),
]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: str(error))
def test_a_traceback_that_ends_in_an_error_makes_it_again(error: TorchptError) -> None:
    name = f"{type(error).__module__}.{type(error).__qualname__}"
    text = f"Caught {name} in DataLoader worker process 0.\nOriginal Traceback:\n  raise it\n{name}: {error}\n"
    again = type(error)(text)  # pyright: ignore[reportCallIssue]
    assert str(again) == str(error) and again.__notes__ == [text]
    for made in (pickle.loads(pickle.dumps(again)), pickle.loads(pickle.dumps(error))):
        assert type(made) is type(error) and str(made) == str(error)
    if isinstance(error, torchpt.SceneError) and isinstance(again, torchpt.SceneError):
        assert (again.key, again.file) == (error.key, error.file) or isinstance(error, torchpt.NotBuiltError)


def test_text_without_a_line_of_our_own_gives_its_last_line() -> None:
    assert str(torchpt.RenderError("one\ntwo\n")) == "two"
