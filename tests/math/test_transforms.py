"""Transforms: order, conventions, and what has no inverse."""

from __future__ import annotations

import numpy as np
import pytest

from torchpt.core.errors import SceneError
from torchpt.math.transforms import apply_points, compose, is_singular, look_at, rotate, similarity_scale


def test_operations_apply_in_the_order_listed() -> None:
    operations = [{"scale": 2}, {"rotate": {"axis": [0, 0, 3], "angle": 90}}, {"translate": [1, 0, 0]}]
    np.testing.assert_allclose(apply_points(compose(operations), np.array([[1.0, 0, 0]])), [[1, 2, 0]], atol=1e-15)
    np.testing.assert_array_equal(compose([]), np.eye(4))


def test_matrix_and_look_at_are_operations() -> None:
    shift = np.eye(4)
    shift[:3, 3] = (1, 2, 3)
    np.testing.assert_array_equal(compose([{"matrix": shift.tolist()}]), shift)
    frame = compose([{"look_at": {"origin": [0, 0, 0], "target": [0, 0, 7]}}])
    np.testing.assert_allclose(frame, np.eye(4), atol=1e-15)


def test_look_at_has_image_right_along_direction_cross_up() -> None:
    frame = look_at((1, 2, 3), (4, -1, 9), (0.1, 1, 0))
    right = np.cross(np.array((3, -3, 6)), (0.1, 1, 0))
    np.testing.assert_allclose(-frame[:3, 0], right / np.linalg.norm(right), atol=1e-14)
    np.testing.assert_allclose(frame[:3, :3].T @ frame[:3, :3], np.eye(3), atol=1e-14)
    assert np.linalg.det(frame[:3, :3]) > 0


@pytest.mark.parametrize("size", [1e-150, 1e-9, 1.0, 1e9, 1e150])
def test_singularity_is_judged_without_scale(size: float) -> None:
    assert not is_singular(np.diag([size, size, size * 1e-6, 1]))
    assert is_singular(np.diag([size, size, size * 1e-14, 1]))


def test_overflow_is_singular() -> None:
    with pytest.raises(SceneError, match="inverse"):
        compose([{"scale": 1e300}, {"scale": 1e300}])


def test_similarity() -> None:
    assert similarity_scale(3.0 * rotate({"axis": [1, 2, 3], "angle": 40})) == pytest.approx(3.0)
    assert similarity_scale(np.diag([1.0, -1.0, 1.0, 1.0])) == pytest.approx(1.0)
    assert similarity_scale(np.diag([1.0, 1.0, 1.1, 1.0])) is None


@pytest.mark.parametrize(
    ("operations", "key"),
    [
        ({"scale": 1}, ""),
        ([3], "0"),
        ([{"scale": 1, "translate": [0, 0, 0]}], "0"),
        ([{"translate": [0, 0]}], "0.translate"),
        ([{"translate": [0, 0, True]}], "0.translate"),
        ([{"scale": 1}, {"scale": "2"}], "1.scale"),
        ([{"rotate": 90}], "0.rotate"),
        ([{"rotate": {"axis": [0, 1, 0]}}], "0.rotate.angle"),
        ([{"rotate": {"axis": [0, 1, 0], "angle": 1, "about": 2}}], "0.rotate.about"),
        ([{"look_at": {"origin": [0, 0, 0], "target": [0, 0, 0]}}], "0.look_at.target"),
        ([{"look_at": {"origin": [0, 0, 0], "target": [0, 2, 0]}}], "0.look_at.up"),
        ([{"matrix": [[1, 2], [3, 4]]}], "0.matrix"),
    ],
)
def test_bad_operations(operations: object, key: str) -> None:
    with pytest.raises(SceneError) as caught:
        compose(operations)
    assert caught.value.key == key
