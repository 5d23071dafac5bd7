"""From parameters to the tensors of waves, and back once a backward pass; and which parameters move geometry.

:mod:`torchpt.scene.world` builds world and camera from the parameters on an autograd tape. Chunks of lanes are differentiated
with respect to the tensors of the world; their gradient sums are pulled back to the parameters once, at the end. Those tensors,
cut from the tape of the parameters, are the leaves; their detached twins are the primals.

``rendering/derivatives.py`` makes a :class:`SceneTape` for each backward pass, through :func:`torchpt.gradients.gradients`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchpt.core.autograd import gradients_of
from torchpt.core.memory import Budget, Span
from torchpt.core.tree import map_leaves
from torchpt.math.microfacet import is_smooth
from torchpt.math.sums import GradientSums
from torchpt.paths.adjoint import Tape
from torchpt.paths.wave import Wave
from torchpt.physics.bsdfs.resolved import ResolvedMaterial
from torchpt.physics.shapes.geometry import LaneGeometry
from torchpt.physics.textures import Node
from torchpt.physics.textures.atlas import ImageNode
from torchpt.ranks import Group, blocks
from torchpt.scene import Scene
from torchpt.scene.prepare import make_wave
from torchpt.scene.settings import Settings
from torchpt.spec import Moves

__all__ = ["SceneTape", "attached", "is_mirror", "near_of"]


# ---- Which parameters move geometry, by their specs: gradients of colours then need no derivatives of geometry


#: Numbers that tell how rough a material is.
_ROUGHNESS = ("alpha", "roughness", "alpha_u", "alpha_v")
#: Parameters of maps of normals.
_MAPS = ("normal_map", "normal_strength", "bump_map")


def attached(scene: Scene, names: Iterable[str]) -> bool:
    """Return True if a parameter moves surfaces or the camera, or changes the direction of rays behind delta lobes."""
    owners = [*scene.built.parts, *scene.built.copies]
    materials = [material for owner in owners for material in owner.material.with_inner()]
    # Materials with smooth refraction: their index of refraction sets the direction of the refracted ray.
    turned = {f"{material.name}." for material in materials if material.refracts_as_delta}
    # Mirrors and smooth coats: maps of their normals set the direction of the reflected ray.
    params = scene.readable_params()
    for material in materials:
        if (material.normal_map is not None or material.bump_map is not None) and is_mirror(material, params):
            turned |= {f"{material.name}.{name}" for name in _MAPS}

    def is_attached(name: str) -> bool:
        moves = scene.spec(name).moves
        if moves is Moves.RAYS:  # of such a material, or of a texture that it may read
            return name.startswith(tuple(turned)) or bool(turned and "textures." in name)
        return moves is Moves.SURFACES

    return any(map(is_attached, names))


def is_mirror(material: ResolvedMaterial, params: Mapping[str, Tensor]) -> bool:
    """Return True if a material reflects or refracts as a delta: rough ones only where their roughness is next to 0."""
    if material.inner or material.model.sheer or not material.model.delta:  # inner ones are looked at by themselves
        return False
    if material.model.smooth:
        return True
    widest = [_least(material, name, params) for name in _ROUGHNESS if material.values.get(name) is not None]
    return not widest or bool(is_smooth(torch.stack(widest).amax()))


def _least(material: ResolvedMaterial, name: str, params: Mapping[str, Tensor]) -> Tensor:
    """Return the least value of a number of a material; 0 of a texture of a kind of its own."""
    value = material.values[name]
    if isinstance(value, ImageNode):
        return (value.image(params).amin() * value.scale[0]).detach().double()
    least = torch.zeros(()) if isinstance(value, Node) else params[f"{material.name}.{name}"].detach().amin()
    return least.double()


# ---- The length over which points slide along their rays


#: Share of the scene's size where nothing but the camera moves.
_NEAR = 0.25


@torch.no_grad()
def near_of(scene: Scene, geometry: LaneGeometry, wanted: Iterable[str]) -> Tensor:
    """Return the length ``(1,)`` float64 over which points slide along their rays in place of being held.

    It is about half the diagonal of the box around all that moves. It changes no gradient's mean, but its variance: see
    :func:`torchpt.physics.shapes.interaction.reattach`.

    Args:
        scene: the scene.
        geometry: its primitives.
        wanted: names of the parameters that are differentiated.
    """
    names = [name for name in wanted if scene.spec(name).moves is Moves.SURFACES]

    def moves(owner: str) -> bool:
        return any(name.startswith(f"{owner}.") for name in names)

    boxes = _boxes(scene, geometry)
    moving = [boxes[part.name] for part in scene.built.parts if moves(part.name)]
    moving += [boxes[copy.name] for copy in scene.built.copies if moves(copy.name) or moves(copy.of)]
    return (_half_diagonal(moving) if moving else _NEAR * _half_diagonal(boxes.values()))[None]


@torch.no_grad()
def scene_reach(scene: Scene, geometry: LaneGeometry) -> Tensor:
    """Return about half the diagonal of the box around all primitives, float64."""
    return _half_diagonal(_boxes(scene, geometry).values())


def _half_diagonal(boxes: Iterable[Tensor]) -> Tensor:
    """Return half the diagonal of the box around boxes."""
    low, high = torch.stack(list(boxes)).unbind(1)
    return 0.5 * (high.amax(0) - low.amin(0)).norm()


def _boxes(scene: Scene, geometry: LaneGeometry) -> dict[str, Tensor]:
    """Return boxes ``(2, 3)`` around the parts and instances by name: least and greatest coordinates, about."""
    p0, e1, e2 = (corner.double() for corner in (geometry.p0, geometry.e1, geometry.e2))
    low, high = torch.minimum(e1, e2).clamp_max(0.0), torch.maximum(e1, e2).clamp_min(0.0)
    four = slice(geometry.counts[0], sum(geometry.counts[:2]))
    fourth = e1[:, four] + e2[:, four]
    low[:, four], high[:, four] = torch.minimum(low[:, four], fourth), torch.maximum(high[:, four], fourth)
    round_ = slice(sum(geometry.counts[:2]), None)  # disks, spheres and quadrics are about p0
    radius = torch.maximum(e1[:, round_].norm(dim=0), e2[:, round_].norm(dim=0))
    low[:, round_], high[:, round_] = -radius, radius
    low, high = p0 + low, p0 + high
    boxes: dict[str, Tensor] = {}
    first = 0
    for part in scene.built.parts:
        end = first + part.primitive_count
        box = torch.stack((low[:, first:end].amin(1), high[:, first:end].amax(1)))
        before = boxes.get(part.name, box)  # a shape may have several parts of its name
        boxes[part.name] = torch.stack((torch.minimum(box[0], before[0]), torch.maximum(box[1], before[1])))
        first = end
    for k, copy in enumerate(scene.built.copies, 1):
        assert geometry.copies is not None
        x, y, z, move = (getattr(geometry.copies, name)[:, k].double() for name in ("x", "y", "z", "move"))
        ends = torch.cartesian_prod(*boxes[copy.of].T)  # the corners of the mesh's box
        placed = ends @ torch.stack((x, y, z)) + move
        boxes[copy.name] = torch.stack((placed.amin(0), placed.amax(0)))
    return boxes


# ---- From parameters to the tensors of waves, and back once a backward pass


class SceneTape(Tape):
    """The tape of a backward pass: tensors of the wave as functions of the parameters.

    Args:
        scene: the scene.
        settings: of the backward pass.
        params: parameters in place of the scene's.
        wanted: names of the parameters to differentiate.
        captured: differentiated tensors that stages hold by themselves, such as weights of modules.
        dtype: of the lanes.
        attached: True: geometry is differentiated.
        ranks: processes that share the pixels; None: a single process.
        rays: rays in place of camera rays, see :func:`torchpt.scene.prepare.make_wave`.
        differentiates_rays: True: rays are differentiated too.
    """

    # `_inputs`: autograd leaves, the wanted parameters and then the rays. `_outputs`: the tensors of the wave that depend on
    # them, in the order of the tape's leaves.

    def __init__(
        self,
        scene: Scene,
        settings: Settings,
        params: Mapping[str, Tensor],
        wanted: Sequence[str],
        captured: Sequence[Tensor],
        dtype: torch.dtype,
        *,
        attached: bool,
        ranks: Group | None = None,
        rays: tuple[Tensor, Tensor] | None = None,
        differentiates_rays: bool = False,
    ) -> None:
        self._ranks = ranks
        self._inputs = [params[name].detach().requires_grad_() for name in wanted]
        if rays is not None:
            o, d = (tensor.detach().requires_grad_(differentiates_rays) for tensor in rays)
            rays = o, d
            self._inputs += [o, d] if differentiates_rays else []
        # The inputs may end with the rays, which have no name.
        given = {name: value.detach() if value.requires_grad else value for name, value in params.items()}
        given |= dict(zip(wanted, self._inputs, strict=False))
        with torch.enable_grad():
            taped_wave = make_wave(scene, settings, given, dtype, tape=True, attached=attached, rays=rays)
        if attached:
            near = near_of(scene, taped_wave.context.world.geometry, wanted).to(dtype)
            taped_wave = replace(taped_wave, context=replace(taped_wave.context, near=near))
        self._outputs: list[Tensor] = []
        primals: dict[int, Tensor] = {}  # by id of the tensor on the tape
        leaves: dict[int, Tensor] = {}  # by id of the primal

        def detached(tensor: Tensor) -> Tensor:
            # Other leaves are weights of modules: they are in `captured`, and stages read the modules' own tensors.
            if not tensor.requires_grad or (tensor.is_leaf and id(tensor) not in inputs):
                return tensor
            if id(tensor) not in primals:
                primals[id(tensor)] = tensor.detach()
                self._outputs.append(tensor)
            return primals[id(tensor)]

        def leaf(tensor: Tensor) -> Tensor:
            return leaves.get(id(tensor), tensor)

        inputs = {id(tensor) for tensor in self._inputs}
        wave = _map_tensors(taped_wave, detached)
        detached_outputs = [primals[id(tensor)] for tensor in self._outputs]
        leaves |= {id(primal): primal.detach().requires_grad_() for primal in detached_outputs}
        super().__init__(
            wave=wave,
            taped=_map_tensors(wave, leaf),
            leaves=[leaves[id(primal)] for primal in detached_outputs],
            primals=detached_outputs,
            captured=tuple(captured),
        )

    def blocks(self, pixels: int, samples: int) -> list[tuple[int, int]]:
        """Return the blocks of consecutive pixels, first and number, of this process; the same for all engines."""
        return blocks(pixels, samples, self._ranks)

    def run_in_chunks(self, budget: Budget, work: Callable[[Span], None], pixels: int, samples: int) -> None:
        """Call ``work`` with the chunks of this process's :meth:`blocks`, as large as the budget allows.

        A chunk is first pixel, number of pixels, first sample and number of samples of each.
        """
        for start, count in self.blocks(pixels, samples):

            def work_in_block(span: Span, start: int = start) -> None:
                first_pixel, count, first_sample, samples = span  # pixels count from the first of the block
                work((start + first_pixel, count, first_sample, samples))

            for _ in budget.run_in_chunks(work_in_block, count, 0, samples):
                pass  # running the iterator calls `work`

    def sums(self) -> GradientSums:
        """Return zero gradient sums for the leaves and the captured tensors."""
        return GradientSums(self.tables)

    def gradients(self, sums: GradientSums) -> list[Tensor]:
        """Return gradients of parameters, rays and captured tensors from the gradient sums of the leaves."""
        leaf_grads = sums.gradients()  # of the leaves, then of the captured tensors
        pairs = [(output, grad) for output, grad in zip(self._outputs, leaf_grads, strict=False) if grad is not None]
        input_grads: Sequence[Tensor | None] = [None] * len(self._inputs)
        if pairs and self._inputs:
            outputs, cotangents = [output for output, _ in pairs], [grad for _, grad in pairs]
            input_grads = gradients_of(outputs, self._inputs, cotangents)
        captured_grads = leaf_grads[len(self.leaves) :]
        results = zip((*self._inputs, *self.captured), (*input_grads, *captured_grads), strict=True)
        return [torch.zeros_like(tensor) if gradient is None else gradient for tensor, gradient in results]

    def leaf_tangents(self, tangents: Sequence[Tensor]) -> list[Tensor]:
        """Return tangents of the leaves, given those of the inputs: the JVP of the assembly, as the VJP of its VJP."""
        outputs, inputs = self._outputs, self._inputs
        if not outputs:  # no lane reads the inputs, such as a material without surfaces
            return []
        with torch.enable_grad():
            cotangents = [torch.zeros_like(output, requires_grad=True) for output in outputs]
            grads = torch.autograd.grad(outputs, inputs, cotangents, create_graph=True, allow_unused=True)
            pairs = [(grad, u) for grad, u in zip(grads, tangents, strict=True) if grad is not None]
            found = torch.autograd.grad([g for g, _ in pairs], cotangents, [u for _, u in pairs], allow_unused=True)
        return [torch.zeros_like(leaf) if u is None else u for leaf, u in zip(self.leaves, found, strict=True)]

    def products(self, grads: Sequence[Tensor], products: Sequence[Tensor], tangents: Sequence[Tensor]) -> list[Tensor]:
        """Return Hessian products with the inputs.

        Args:
            grads: gradients of the leaves.
            products: Hessian products with the leaves.
            tangents: of the inputs.
        """
        outputs, inputs = self._outputs, self._inputs
        if not outputs:
            return [torch.zeros_like(tensor) for tensor in inputs]
        with torch.enable_grad():
            first = torch.autograd.grad(outputs, inputs, grads, create_graph=True, allow_unused=True)
            # The second derivative of the assembly itself, where it is not linear.
            change = [(grad * u).sum() for grad, u in zip(first, tangents, strict=True) if grad is not None]
            change = [part for part in change if part.requires_grad]
            own = (
                torch.autograd.grad(change, inputs, retain_graph=True, allow_unused=True)
                if change
                else [None] * len(inputs)
            )
        through = torch.autograd.grad(outputs, inputs, products, allow_unused=True)
        zeros = (torch.zeros_like(tensor) for tensor in inputs)
        return [zero + sum(x for x in pair if x is not None) for zero, *pair in zip(zeros, own, through, strict=True)]


def _map_tensors(wave: Wave, change: Callable[[Tensor], Tensor]) -> Wave:
    """Return the wave with ``change`` applied to all of its tensors."""
    context = wave.context
    records = context.world, context.pixel, wave.camera, wave.first_surface, wave.start_rays
    world, pixel, camera, first_surface, start_rays = map_leaves(change, records)
    context = replace(context, world=world, pixel=pixel, camera=None if context.camera is None else camera)
    return replace(wave, context=context, camera=camera, first_surface=first_surface, start_rays=start_rays)
