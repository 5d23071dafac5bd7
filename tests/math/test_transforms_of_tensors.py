"""Transforms and poses of tensors are those of numbers, and their derivatives those of differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchpt.math import transforms
from torchpt.physics.cameras import opencv, poses
from torchpt.physics.shapes import KINDS
from torchpt.physics.shapes.base import Place, Size
from torchpt.spec import parameters_of

CPU = torch.device("cpu")
DRAWN = np.random.default_rng(7).normal(size=(40, 3))
LISTS: dict[str, list[Any]] = {
    "translate": [{"translate": DRAWN[0]}],
    "scale": [{"scale": 2.5}],
    "scales": [{"scale": DRAWN[1]}],
    "rotate": [{"rotate": {"axis": DRAWN[2], "angle": 100.0}}],
    "rotate far": [{"rotate": {"axis": [0, 1e-20, 0], "angle": -1000.0}}],
    "matrix": [{"matrix": np.vstack((np.hstack((DRAWN[3:6], DRAWN[6:7].T)), [[0, 0, 0, 1]]))}],
    "look_at": [{"look_at": {"origin": DRAWN[7], "target": DRAWN[8], "up": DRAWN[9]}}],
    "look_at upright": [{"look_at": {"origin": DRAWN[7], "target": DRAWN[8]}}],
}
LISTS["all of them"] = [step for steps in LISTS.values() for step in steps if "1e-20" not in repr(step)]


def of_tensors(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: of_tensors(item) for key, item in value.items()}
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return [of_tensors(item) for item in value]
    return torch.tensor(np.asarray(value), dtype=torch.float64)


@pytest.mark.parametrize("name", LISTS)
def test_operations(name: str) -> None:
    expected = torch.from_numpy(transforms.compose(LISTS[name]))
    for given in (LISTS[name], of_tensors(LISTS[name])):
        assert torch.allclose(transforms.compose(given, CPU), expected, rtol=1e-12, atol=1e-13)


def test_derivatives_of_operations() -> None:
    def composed(offset: Tensor, factor: Tensor, axis: Tensor, angle: Tensor, eye: Tensor, target: Tensor) -> Tensor:
        steps = [
            {"look_at": {"origin": eye, "target": target}},
            {"rotate": {"axis": axis, "angle": angle}},
            {"scale": factor},
            {"translate": [offset[0], 2.0, offset[2]]},
        ]
        return transforms.compose(steps, CPU)

    inputs = [of_tensors(DRAWN[k]) for k in (0, 1, 2)] + [of_tensors(35.0), of_tensors(DRAWN[4]), of_tensors(DRAWN[5])]
    assert torch.autograd.gradcheck(composed, [x.requires_grad_() for x in inputs], eps=1e-6, atol=1e-6)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_own_sizes_of_shapes(kind: str) -> None:
    specs = {name: spec for name, spec in parameters_of(KINDS[kind]).items() if isinstance(spec, Size | Place)}
    values = {name: tuple(DRAWN[10]) if isinstance(spec, Place) else abs(DRAWN[11][0]) for name, spec in specs.items()}
    for sign in (1.0, -1.0):
        if "apex" in values:
            values["height"] = sign * 0.7
        expected = KINDS[kind].own(values)
        found = KINDS[kind].own({name: of_tensors(value) for name, value in values.items()})
        assert (found is None) == (expected is None) == (not specs)
        if found is not None:
            assert isinstance(expected, np.ndarray) and torch.allclose(found, torch.from_numpy(expected), atol=1e-14)
        for name in values:  # one tensor is enough
            one = KINDS[kind].own({**values, name: of_tensors(values[name])})
            assert torch.allclose(one, torch.from_numpy(expected), atol=1e-14)


TURN = np.linalg.qr(DRAWN[20:23])[0]
TURN = TURN * np.linalg.det(TURN)


@pytest.mark.parametrize(
    "given",
    [
        {"origin": DRAWN[30], "target": DRAWN[31]},
        {"origin": DRAWN[30], "target": DRAWN[31], "up": DRAWN[32]},
        {"to_world": np.vstack((np.hstack((TURN, DRAWN[33:34].T)), [[0, 0, 0, 1]]))},
        {"R": TURN, "t": DRAWN[34]},
    ],
)
def test_poses_of_cameras(given: dict[str, Any]) -> None:
    values = {**dict.fromkeys(("origin", "target", "up", "to_world", "R", "t")), **given}
    read = {key: None if value is None else tuple(value) if value.ndim == 1 else value for key, value in values.items()}
    expected = torch.from_numpy(poses.pose_of(read | ({"t": given["t"]} if "t" in given else {}), frozenset(given)))
    for written in (given, of_tensors(given)):
        assert torch.allclose(poses.posed({"type": "perspective", **written}, CPU), expected, rtol=1e-12, atol=1e-13)


def test_calibrations() -> None:
    inner = np.array([[70.0, 0, 29.5], [0, 55.0, 27.25], [0, 0, 1]])
    expected = opencv.parameters_of_k(inner, (64, 48))
    found = opencv.numbers_of_k(of_tensors(inner), (64, 48))
    assert {**found, "fov_axis": "x"} == pytest.approx(expected)
    assert found.keys() | {"fov_axis"} == expected.keys()
