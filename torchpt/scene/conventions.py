"""Cameras as other libraries have them: blocks of a scene made of theirs, and theirs made of a scene's camera.

All agree on a pinhole of ``fx fy cx cy`` in pixels; they differ in axes, in which way the pose goes, and in where pixels are
counted from.

====================  =======================================  ==================  ==========================
whose                 axes of the camera                       pose                the first pixel's middle
====================  =======================================  ==================  ==========================
torchpt, Mitsuba      x left, y up, looks along +z             camera to world     (0.5, 0.5)
OpenCV's, COLMAP      x right, y down, looks along +z          world to camera     (0.5, 0.5) in COLMAP
cv2, kornia           x right, y down, looks along +z          world to camera     (0, 0)
OpenGL, glTF,         x right, y up, looks along -z            camera to world     (0.5, 0.5)
Blender, NeRF
PyTorch3D             x left, y up, looks along +z             world to camera,    (0.5, 0.5) on its screen
                                                               rows times ``R``
====================  =======================================  ==================  ==========================

Tensors go in and come out: gradients flow through both ways. Numbers, lists and arrays are taken as well.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchpt.core.autograd import is_transformed
from torchpt.core.errors import SceneError
from torchpt.math.transforms import affine
from torchpt.physics.cameras import opencv
from torchpt.physics.cameras.opencv import PinholeMatrices
from torchpt.physics.cameras.pinhole import FOV_AXES
from torchpt.spec import Refused

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

    from torchpt.scene.scene import Scene

__all__ = [
    "OpenGLCamera", "from_kornia", "from_opencv", "from_opengl", "from_pytorch3d", "to_kornia", "to_opencv", "to_opengl",
    "to_pytorch3d",
]  # fmt: skip

#: A scene's ``camera`` block.
Block = dict[str, Any]
#: Width and height of a picture in pixels.
Size = tuple[int, int]


class OpenGLCamera(NamedTuple):
    """A camera with OpenGL's axes: those of glTF, Blender and NeRF."""

    matrix: Tensor  # (4, 4) camera to world; x right, y up, looks along -z
    K: Tensor  # (3, 3) in pixels from the picture's corner
    fov: Tensor  # (2,) degrees along x and y, of a film whose middle it looks at
    size: Size


def from_opencv(K: Any, R: Any, t: Any, size: Size, first_pixel: float = 0.5) -> Block:
    """A camera of OpenCV's matrices: a point ``X`` of the world lies at ``R X + t`` (+x right, +y down, +z ahead).

    Args:
        K: ``(3, 3)`` in pixels, without skew.
        R: ``(3, 3)`` rotation.
        t: ``(3,)``.
        size: width and height in pixels of the picture that ``K`` belongs to.
        first_pixel: where ``K`` has the middle of the first pixel, along x and y: 0.5 as COLMAP, 0 as ``cv2``.

    Raises:
        SceneError: numbers that are not finite or of another shape, an ``R`` that is no rotation, or no size.
    """
    inner, wide_and_tall = _with_offset(_tensor(K, "K", (3, 3)), 0.5 - _first_pixel(first_pixel)), size_of(size)
    pose = {"R": _rotation(R), "t": _tensor(t, "t", (3,))}
    return {"type": "perspective", "K": inner, **pose, "size": wide_and_tall}


def to_opencv(
    scene: Scene,
    params: Mapping[str, Tensor] | None = None,
    film: Mapping[str, Any] | None = None,
    dtype: torch.dtype = torch.float32,
    first_pixel: float = 0.5,
) -> tuple[Tensor, Tensor, Tensor]:
    """``K (3, 3)``, ``R (3, 3)`` and ``t (3,)`` of a scene's camera.

    Args:
        scene: whose.
        params: tensors in place of the scene's; gradients flow to those of the camera, and to the scene's own.
        film: film settings in place of the scene's own, such as ``width`` and ``height``.
        dtype: of the matrices.
        first_pixel: where ``K`` is to have the middle of the first pixel.

    Raises:
        SceneError: no scene, parameters or film settings that are wrong, or a camera that is no pinhole's.
    """
    inner, rotation, translation = _seen(scene, params, film, dtype)
    return _with_offset(inner, _first_pixel(first_pixel) - 0.5).to(dtype), rotation.to(dtype), translation.to(dtype)


def from_opengl(
    matrix: Any,
    fov: Any = None,
    fov_axis: str = "x",
    *,
    K: Any = None,
    size: Size | None = None,
    first_pixel: float = 0.5,
) -> Block:
    """A camera of OpenGL's axes: of glTF, Blender and NeRF.

    Args:
        matrix: ``(4, 4)`` or ``(3, 4)`` camera to world; x right, y up, looks along -z. A scale is ignored, as in glTF.
        fov: full angle in *degrees* (glTF's ``yfov`` and NeRF's ``camera_angle_x`` are radians).
        fov_axis: what it spans: ``y`` for glTF's, ``x`` for NeRF's, ``larger`` for Blender's.
        K: ``(3, 3)`` in place of ``fov``, in pixels of a picture of ``size``.
        size: width and height in pixels of that picture.
        first_pixel: where ``K`` has the middle of the first pixel.

    Raises:
        SceneError: neither a ``fov`` nor ``K``, or both; a ``K`` without ``size``; numbers that are not finite, of another
            shape or out of range, or a matrix with an axis of no length.
    """
    if (fov is None) == (K is None):
        raise SceneError("fov", fov, "an angle in degrees, or K and size, one of the two")
    if K is not None and size is None:
        raise SceneError("size", size, "[width, height] of the picture that K belongs to")
    pose = _pose(matrix)
    block: Block = {
        "type": "perspective",
        "to_world": affine(pose[:, :3] * pose.new_tensor([-1.0, 1.0, -1.0]), pose[:, 3]),
    }
    if K is None:
        angle = _tensor(fov, "fov", ())
        if not is_transformed(angle) and not 0.0 < float(angle) < 180.0:
            raise SceneError("fov", fov, "an angle in degrees above 0 and below 180")
        if fov_axis not in FOV_AXES:
            raise SceneError("fov_axis", fov_axis, f"one of {', '.join(FOV_AXES)}")
        return {**block, "fov": fov, "fov_axis": fov_axis}
    return {**block, "K": _with_offset(_tensor(K, "K", (3, 3)), 0.5 - _first_pixel(first_pixel)), "size": size_of(size)}


def to_opengl(
    scene: Scene,
    params: Mapping[str, Tensor] | None = None,
    film: Mapping[str, Any] | None = None,
    dtype: torch.dtype = torch.float32,
) -> OpenGLCamera:
    """A scene's camera with OpenGL's axes. Arguments and errors as :func:`to_opencv`."""
    inner, rotation, translation = _seen(scene, params, film, dtype)
    width, height = scene.film_size(film)
    matrix = affine(rotation.T * rotation.new_tensor([1.0, -1.0, -1.0]), -(rotation.T @ translation))
    halves = inner.new_tensor([width, height]) * 0.5
    fov = torch.atan2(halves, torch.stack((inner[0, 0], inner[1, 1]))) * (360.0 / math.pi)
    return OpenGLCamera(matrix.to(dtype), inner.to(dtype), fov.to(dtype), (width, height))


def from_kornia(camera: PinholeCamera, index: int = 0) -> Block:
    """One of the cameras of kornia's ``PinholeCamera``, in whose pixels the first one's middle is (0, 0).

    Args:
        camera: the batch of cameras.
        index: which of them.

    Raises:
        SceneError: no such camera.
    """
    if not all(hasattr(camera, name) for name in ("extrinsics", "intrinsics", "width", "height")):
        raise SceneError("camera", camera, "kornia's PinholeCamera")
    count = len(camera.extrinsics)
    try:
        index = range(count)[operator.index(index)]
    except (IndexError, TypeError):
        raise SceneError("index", index, f"a whole number below {count}, the number of cameras") from None
    outer = camera.extrinsics[index]
    size: Any = camera.width[index], camera.height[index]
    return from_opencv(camera.intrinsics[index, :3, :3], outer[:3, :3], outer[:3, 3], size, 0.0)


def to_kornia(
    scene: Scene,
    params: Mapping[str, Tensor] | None = None,
    film: Mapping[str, Any] | None = None,
    dtype: torch.dtype = torch.float32,
) -> PinholeCamera:
    """A scene's camera as kornia's ``PinholeCamera``, a batch of one. Arguments and errors as :func:`to_opencv`.

    ``project`` gives pixels as kornia counts them: a point that is seen in the middle of ``image[row, column]`` lies at
    ``(column, row)``.
    """
    from kornia.geometry.camera import PinholeCamera

    inner, rotation, translation = _seen(scene, params, film, dtype)
    inner = _with_offset(inner, -0.5)
    whole = affine(inner, torch.zeros_like(translation))
    size = [torch.tensor([side], device=rotation.device) for side in scene.film_size(film)]
    return PinholeCamera(whole[None].to(dtype), affine(rotation, translation)[None].to(dtype), size[1], size[0])


def from_pytorch3d(
    R: Any, T: Any, focal_length: Any, principal_point: Any = (0.0, 0.0), *, image_size: Any, in_ndc: bool = True
) -> Block:
    """A camera of the numbers that PyTorch3D's ``PerspectiveCameras`` has: one camera, or a batch of one.

    Args:
        R: ``(3, 3)``: a point is a row, and lies at ``X R + T`` in the camera's space.
        T: ``(3,)``.
        focal_length: ``()`` or ``(2,)``.
        principal_point: ``(2,)``.
        image_size: height and width in pixels, in this order.
        in_ndc: whether the two before are in PyTorch3D's normalized coordinates, whose smaller side is 2 long; else in pixels.

    Raises:
        SceneError: numbers that are not finite or of another shape.
    """
    if type(in_ndc) is not bool:
        raise SceneError("in_ndc", in_ndc, "True or False")
    # Ours is the same camera space, and R's columns are its axes in the world.
    rotation, translation = _rotation(R), _tensor(T, "T", (3,))
    tall, wide = size_of(_tensor(image_size, "image_size", (2,)), "image_size", "[height, width]")
    focal, point = _tensor(focal_length, "focal_length", None), _tensor(principal_point, "principal_point", (2,))
    if focal.numel() not in (1, 2):
        raise SceneError("focal_length", f"shape {tuple(focal.shape)}", "one number, or two")
    focal = focal.reshape(-1).expand(2)
    if in_ndc:
        half = min(wide, tall) * 0.5
        focal, point = focal * half, point.new_tensor([wide, tall]) * 0.5 - point * half
    zero = torch.zeros_like(focal[0])
    inner = (focal[0], zero, point[0], zero, focal[1], point[1], zero, zero, torch.ones_like(zero))
    pose = affine(rotation, -(rotation @ translation))
    return {"type": "perspective", "to_world": pose, "K": torch.stack(inner).reshape(3, 3), "size": [wide, tall]}


def to_pytorch3d(
    scene: Scene,
    params: Mapping[str, Tensor] | None = None,
    film: Mapping[str, Any] | None = None,
    dtype: torch.dtype = torch.float32,
) -> dict[str, Any]:
    """What PyTorch3D's ``PerspectiveCameras(**numbers)`` takes, a batch of one. Arguments and errors as :func:`to_opencv`."""
    inner, rotation, translation = _seen(scene, params, film, dtype)
    wide, tall = scene.film_size(film)
    half, flip = min(wide, tall) * 0.5, rotation.new_tensor([-1.0, -1.0, 1.0])
    numbers = {
        "R": rotation.T * flip,
        "T": translation * flip,
        "focal_length": inner.diagonal()[:2] / half,
        "principal_point": (inner.new_tensor([wide, tall]) * 0.5 - inner[:2, 2]) / half,
    }
    found: dict[str, Any] = {key: value[None].to(dtype) for key, value in numbers.items()}
    return {**found, "image_size": torch.tensor([[tall, wide]], device=rotation.device), "in_ndc": True}


def _seen(
    scene: Any, params: Mapping[str, Tensor] | None, film: Mapping[str, Any] | None, dtype: Any
) -> PinholeMatrices:
    """A scene's camera in float64, once ``dtype``, which the caller is to give it, is one."""
    if not hasattr(scene, "pinhole"):
        raise SceneError("scene", scene, "a scene from torchpt.load")
    if not isinstance(dtype, torch.dtype) or not dtype.is_floating_point:
        raise SceneError("dtype", dtype, "a floating dtype such as torch.float32")
    return scene.pinhole(params, film, torch.float64)


def _numbers(value: Any, key: str, expected: str) -> Tensor:
    """Finite numbers in float64; of a transform of ``torch.func``, where values are not to be looked at, whatever they are."""
    given = value if isinstance(value, Tensor) else None
    if given is not None and (given.layout is not torch.strided or given.is_complex() or given.is_meta):
        raise SceneError(
            key, f"a {given.layout} tensor of {given.dtype} on {given.device}", f"{expected}, dense and real"
        )
    try:
        found = torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise SceneError(key, value, expected) from None
    if not is_transformed(found) and not bool(found.isfinite().all()):
        raise SceneError(key, value, "finite numbers")
    return found


def _rotation(value: Any) -> Tensor:
    """A rotation in float64."""
    found = _tensor(value, "R", (3, 3))
    if not is_transformed(found):
        try:
            opencv.rotation(found.detach().tolist())
        except Refused as error:
            raise SceneError("R", value, error.expected) from None
    return found


def _first_pixel(value: Any) -> float:
    """Where the middle of the first pixel is."""
    return float(_tensor(value, "first_pixel", ()))


def _tensor(value: Any, key: str, shape: tuple[int, ...] | None) -> Tensor:
    """Numbers in float64, of a shape or a batch of one."""
    found = _numbers(value, key, "numbers")
    if shape is not None and found.shape == (1, *shape):
        found = found[0]
    if shape is not None and found.shape != shape:
        raise SceneError(key, f"shape {tuple(found.shape)}", f"numbers of shape {shape}")
    return found


def size_of(size: Any, key: str = "size", sides: str = "[width, height]") -> list[int]:
    """Two sides of a picture in pixels, of whole numbers in any form.

    Raises:
        SceneError: something else.
    """
    expected = f"{sides} in pixels, whole numbers >= 1"
    try:
        found = [] if isinstance(size, str) else [int(side) for side in size]
        whole = len(found) == 2 and all(
            side >= 1 and side == given and given is not True for side, given in zip(found, size, strict=True)
        )
    except (TypeError, ValueError, OverflowError):
        whole, found = False, []
    if not whole:
        raise SceneError(key, size, expected)
    return found


def _pose(matrix: Any) -> Tensor:
    """``(3, 4)`` of a ``(4, 4)`` or ``(3, 4)``, its axes of length 1."""
    found = _numbers(matrix, "matrix", "a matrix (4, 4) or (3, 4)")
    if found.shape not in ((4, 4), (3, 4)):
        raise SceneError("matrix", f"shape {tuple(found.shape)}", "a matrix (4, 4) or (3, 4)")
    last = found.new_tensor([0.0, 0.0, 0.0, 1.0])
    if len(found) == 4 and not is_transformed(found) and not found[3].detach().equal(last):
        raise SceneError("matrix", found[3].tolist(), "a matrix whose last row is 0 0 0 1")
    axes = found[:3, :3]
    lengths = torch.linalg.vector_norm(axes, dim=0)
    if not is_transformed(lengths) and not bool((lengths > 0.0).all()):
        raise SceneError("matrix", matrix, "finite numbers, and axes of a length")
    return torch.cat((axes / lengths, found[:3, 3:]), 1)


def _with_offset(matrix: Tensor, offset: float) -> Tensor:
    """``K`` with its principal point moved by the same number of pixels along both axes."""
    if offset == 0.0:
        return matrix
    return matrix + matrix.new_tensor([[0.0, 0.0, offset], [0.0, 0.0, offset], [0.0, 0.0, 0.0]])
