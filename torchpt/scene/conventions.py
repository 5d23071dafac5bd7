"""Convert cameras between scenes and other libraries, in both directions.

All have a pinhole of ``fx fy cx cy`` in pixels; they differ in axes, in the direction of the pose, and in the coordinates of
the first pixel.

====================  =======================================  ==================  ==========================
library               axes of the camera                       pose                centre of the first pixel
====================  =======================================  ==================  ==========================
torchpt, Mitsuba      x left, y up, looks along +z             camera to world     (0.5, 0.5)
OpenCV's, COLMAP      x right, y down, looks along +z          world to camera     (0.5, 0.5) in COLMAP
cv2, kornia           x right, y down, looks along +z          world to camera     (0, 0)
OpenGL, glTF,         x right, y up, looks along -z            camera to world     (0.5, 0.5)
Blender, NeRF
PyTorch3D             x left, y up, looks along +z             world to camera,    (0.5, 0.5) on its screen
                                                               rows times ``R``
====================  =======================================  ==================  ==========================

``from_...`` returns a scene's ``camera`` block, ``to_...`` takes a loaded scene. Gradients flow through tensors in both
directions. Numbers, lists and arrays are accepted as well.
"""

from __future__ import annotations

import math
import operator
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
    from torchpt.scene.settings import FilmSettings, Params

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
    fov: Tensor  # (2,) degrees along x and y, of a principal point at the centre
    size: Size


def from_opencv(K: Any, R: Any, t: Any, size: Size, first_pixel: float = 0.5) -> Block:
    """Return the camera block for OpenCV's matrices: a world point ``X`` maps to ``R X + t`` (+x right, +y down, +z ahead).

    Args:
        K: ``(3, 3)`` in pixels, without skew.
        R: ``(3, 3)`` rotation.
        t: ``(3,)``.
        size: width and height in pixels of the image that ``K`` belongs to.
        first_pixel: coordinate of the first pixel's centre in ``K``, along x and y: 0.5 as COLMAP, 0 as ``cv2``.

    Raises:
        SceneError: numbers that are not finite or of another shape, an ``R`` that is no rotation, a bad size.
    """
    intrinsics = _with_offset(_tensor(K, "K", (3, 3)), 0.5 - _first_pixel(first_pixel))
    sides = size_of(size)
    pose = {"R": _rotation(R), "t": _tensor(t, "t", (3,))}
    return {"type": "perspective", "K": intrinsics, **pose, "size": sides}


def to_opencv(
    scene: Scene,
    params: Params | None = None,
    film: FilmSettings | None = None,
    dtype: torch.dtype = torch.float32,
    first_pixel: float = 0.5,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return ``K (3, 3)``, ``R (3, 3)`` and ``t (3,)`` of a scene's camera.

    Args:
        scene: the scene.
        params: tensors in place of the scene's; gradients flow to the camera's parameters, here and in the scene.
        film: film settings that override the scene's, such as ``width`` and ``height``.
        dtype: dtype of the matrices.
        first_pixel: coordinate of the first pixel's centre in ``K``.

    Raises:
        SceneError: no scene, wrong parameters or film settings, or a camera other than a pinhole.
    """
    intrinsics, rotation, translation = _pinhole(scene, params, film, dtype)
    return (
        _with_offset(intrinsics, _first_pixel(first_pixel) - 0.5).to(dtype),
        rotation.to(dtype),
        translation.to(dtype),
    )


def from_opengl(
    matrix: Any,
    fov: Any = None,
    fov_axis: str = "x",
    *,
    K: Any = None,
    size: Size | None = None,
    first_pixel: float = 0.5,
) -> Block:
    """Return the camera block for a camera with OpenGL's axes: glTF, Blender, NeRF.

    Args:
        matrix: ``(4, 4)`` or ``(3, 4)`` camera to world; x right, y up, looks along -z. A scale is ignored, as in glTF.
        fov: full angle in *degrees* (glTF's ``yfov`` and NeRF's ``camera_angle_x`` are radians).
        fov_axis: axis of ``fov``: ``y`` for glTF, ``x`` for NeRF, ``larger`` for Blender.
        K: ``(3, 3)`` in place of ``fov``, in pixels of an image of ``size``.
        size: width and height in pixels of that image.
        first_pixel: coordinate of the first pixel's centre in ``K``.

    Raises:
        SceneError: neither ``fov`` nor ``K``, or both; a ``K`` without ``size``; numbers that are not finite, of another
            shape or out of range; a matrix with an axis of length 0.
    """
    if (fov is None) == (K is None):
        raise SceneError("fov", fov, "an angle in degrees, or K and size, one of the two")
    if K is not None and size is None:
        raise SceneError("size", size, "[width, height] of the picture that K belongs to")
    pose = _pose(matrix)
    # The camera space of scenes is this one turned by 180 degrees about y.
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
    params: Params | None = None,
    film: FilmSettings | None = None,
    dtype: torch.dtype = torch.float32,
) -> OpenGLCamera:
    """Return a scene's camera with OpenGL's axes. Arguments and errors as :func:`to_opencv`."""
    intrinsics, rotation, translation = _pinhole(scene, params, film, dtype)
    width, height = scene.film_size(film)
    # The inverse of OpenCV's pose, with the axes y and z turned back.
    matrix = affine(rotation.T * rotation.new_tensor([1.0, -1.0, -1.0]), -(rotation.T @ translation))
    halves = intrinsics.new_tensor([width, height]) * 0.5
    fov = torch.atan2(halves, torch.stack((intrinsics[0, 0], intrinsics[1, 1]))) * (360.0 / math.pi)
    return OpenGLCamera(matrix.to(dtype), intrinsics.to(dtype), fov.to(dtype), (width, height))


def from_kornia(camera: PinholeCamera, index: int = 0) -> Block:
    """Return the camera block for one camera of kornia's ``PinholeCamera``, whose first pixel has its centre at (0, 0).

    Args:
        camera: the batch of cameras.
        index: index in the batch.

    Raises:
        SceneError: no ``PinholeCamera``, or an index out of range.
    """
    if not all(hasattr(camera, name) for name in ("extrinsics", "intrinsics", "width", "height")):
        raise SceneError("camera", camera, "kornia's PinholeCamera")
    count = len(camera.extrinsics)
    try:
        index = range(count)[operator.index(index)]
    except (IndexError, TypeError):
        raise SceneError("index", index, f"a whole number below {count}, the number of cameras") from None
    extrinsics = camera.extrinsics[index]
    size: Any = camera.width[index], camera.height[index]
    return from_opencv(camera.intrinsics[index, :3, :3], extrinsics[:3, :3], extrinsics[:3, 3], size, first_pixel=0.0)


def to_kornia(
    scene: Scene,
    params: Params | None = None,
    film: FilmSettings | None = None,
    dtype: torch.dtype = torch.float32,
) -> PinholeCamera:
    """Return a scene's camera as kornia's ``PinholeCamera``, a batch of one. Arguments and errors as :func:`to_opencv`.

    Its ``project`` returns kornia's pixel coordinates: the centre of ``image[row, column]`` is ``(column, row)``.
    """
    from kornia.geometry.camera import PinholeCamera

    intrinsics, rotation, translation = _pinhole(scene, params, film, dtype)
    intrinsics = _with_offset(intrinsics, -0.5)
    intrinsics_4x4 = affine(intrinsics, torch.zeros_like(translation))
    width, height = (torch.tensor([side], device=rotation.device) for side in scene.film_size(film))
    return PinholeCamera(intrinsics_4x4[None].to(dtype), affine(rotation, translation)[None].to(dtype), height, width)


def from_pytorch3d(
    R: Any, T: Any, focal_length: Any, principal_point: Any = (0.0, 0.0), *, image_size: Any, in_ndc: bool = True
) -> Block:
    """Return the camera block for the arguments of PyTorch3D's ``PerspectiveCameras``: one camera, or a batch of one.

    Args:
        R: ``(3, 3)``; a world point ``X`` is a row and maps to ``X R + T``.
        T: ``(3,)``.
        focal_length: ``()`` or ``(2,)``.
        principal_point: ``(2,)``.
        image_size: height and width in pixels, in this order.
        in_ndc: True where ``focal_length`` and ``principal_point`` are in PyTorch3D's NDC, whose shorter side has length 2;
            else they are in pixels.

    Raises:
        SceneError: numbers that are not finite or of another shape.
    """
    if type(in_ndc) is not bool:
        raise SceneError("in_ndc", in_ndc, "True or False")
    # PyTorch3D's camera space is that of scenes, and R's columns are its axes in the world.
    rotation, translation = _rotation(R), _tensor(T, "T", (3,))
    tall, wide = size_of(_tensor(image_size, "image_size", (2,)), "image_size", "[height, width]")
    focal, point = _tensor(focal_length, "focal_length", None), _tensor(principal_point, "principal_point", (2,))
    if focal.numel() not in (1, 2):
        raise SceneError("focal_length", f"shape {tuple(focal.shape)}", "one number, or two")
    focal = focal.reshape(-1).expand(2)
    if in_ndc:
        half = min(wide, tall) * 0.5  # pixels in a unit of NDC, whose axes point left and up
        focal, point = focal * half, point.new_tensor([wide, tall]) * 0.5 - point * half
    zero = torch.zeros_like(focal[0])
    entries = (focal[0], zero, point[0], zero, focal[1], point[1], zero, zero, torch.ones_like(zero))  # of K, by rows
    pose = affine(rotation, -(rotation @ translation))
    return {"type": "perspective", "to_world": pose, "K": torch.stack(entries).reshape(3, 3), "size": [wide, tall]}


def to_pytorch3d(
    scene: Scene,
    params: Params | None = None,
    film: FilmSettings | None = None,
    dtype: torch.dtype = torch.float32,
) -> dict[str, Any]:
    """Return PyTorch3D's arguments of ``PerspectiveCameras`` for a batch of one. Arguments and errors as :func:`to_opencv`."""
    intrinsics, rotation, translation = _pinhole(scene, params, film, dtype)
    wide, tall = scene.film_size(film)
    # From OpenCV's axes (x right, y down) to PyTorch3D's (x left, y up); a unit of NDC is half the shorter side.
    half, flip = min(wide, tall) * 0.5, rotation.new_tensor([-1.0, -1.0, 1.0])
    numbers = {
        "R": rotation.T * flip,
        "T": translation * flip,
        "focal_length": intrinsics.diagonal()[:2] / half,
        "principal_point": (intrinsics.new_tensor([wide, tall]) * 0.5 - intrinsics[:2, 2]) / half,
    }
    found: dict[str, Any] = {key: value[None].to(dtype) for key, value in numbers.items()}
    return {**found, "image_size": torch.tensor([[tall, wide]], device=rotation.device), "in_ndc": True}


def _pinhole(scene: Any, params: Params | None, film: FilmSettings | None, dtype: Any) -> PinholeMatrices:
    """Return a scene's pinhole matrices in float64, after checking ``dtype``, to which callers convert."""
    if not hasattr(scene, "pinhole"):
        raise SceneError("scene", scene, "a scene from torchpt.load")
    if not isinstance(dtype, torch.dtype) or not dtype.is_floating_point:
        raise SceneError("dtype", dtype, "a floating dtype such as torch.float32")
    return scene.pinhole(params, film, torch.float64)


def _numbers(value: Any, key: str, expected: str) -> Tensor:
    """Return finite numbers as float64; under a transform of ``torch.func`` values cannot be read and are not checked."""
    if isinstance(value, Tensor) and (value.layout is not torch.strided or value.is_complex() or value.is_meta):
        raise SceneError(
            key, f"a {value.layout} tensor of {value.dtype} on {value.device}", f"{expected}, dense and real"
        )
    try:
        found = torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise SceneError(key, value, expected) from None
    if not is_transformed(found) and not bool(found.isfinite().all()):
        raise SceneError(key, value, "finite numbers")
    return found


def _rotation(value: Any) -> Tensor:
    """Return a rotation in float64."""
    found = _tensor(value, "R", (3, 3))
    if not is_transformed(found):
        try:
            opencv.rotation(found.detach().tolist())
        except Refused as error:
            raise SceneError("R", value, error.expected) from None
    return found


def _first_pixel(value: Any) -> float:
    """Return ``first_pixel`` as a float."""
    return float(_tensor(value, "first_pixel", ()))


def _tensor(value: Any, key: str, shape: tuple[int, ...] | None) -> Tensor:
    """Return numbers of a shape, or of a batch of one, in float64."""
    found = _numbers(value, key, "numbers")
    if shape is not None and found.shape == (1, *shape):
        found = found[0]
    if shape is not None and found.shape != shape:
        raise SceneError(key, f"shape {tuple(found.shape)}", f"numbers of shape {shape}")
    return found


def size_of(size: Any, key: str = "size", sides: str = "[width, height]") -> list[int]:
    """Return the two sides of an image in pixels as ints, from whole numbers of any type.

    Raises:
        SceneError: anything else.
    """
    expected = f"{sides} in pixels, whole numbers >= 1"
    try:
        found = [] if isinstance(size, str) else [int(side) for side in size]
        is_valid = len(found) == 2 and all(
            side >= 1 and side == given and given is not True for side, given in zip(found, size, strict=True)
        )
    except (TypeError, ValueError, OverflowError):
        is_valid, found = False, []
    if not is_valid:
        raise SceneError(key, size, expected)
    return found


def _pose(matrix: Any) -> Tensor:
    """Return ``(3, 4)`` of a ``(4, 4)`` or ``(3, 4)`` matrix, with axes of length 1."""
    found = _numbers(matrix, "matrix", "a matrix (4, 4) or (3, 4)")
    if found.shape not in ((4, 4), (3, 4)):
        raise SceneError("matrix", f"shape {tuple(found.shape)}", "a matrix (4, 4) or (3, 4)")
    last_row = found.new_tensor([0.0, 0.0, 0.0, 1.0])
    if len(found) == 4 and not is_transformed(found) and not found[3].detach().equal(last_row):
        raise SceneError("matrix", found[3].tolist(), "a matrix whose last row is 0 0 0 1")
    axes = found[:3, :3]
    lengths = torch.linalg.vector_norm(axes, dim=0)
    if not is_transformed(lengths) and not bool((lengths > 0.0).all()):
        raise SceneError("matrix", matrix, "finite numbers, and axes of a length")
    return torch.cat((axes / lengths, found[:3, 3:]), 1)


def _with_offset(matrix: Tensor, offset: float) -> Tensor:
    """Return ``K`` with the principal point moved by ``offset`` pixels along both axes."""
    if offset == 0.0:
        return matrix
    return matrix + matrix.new_tensor([[0.0, 0.0, offset], [0.0, 0.0, offset], [0.0, 0.0, 0.0]])
