"""Ray intersection: acceleration structures that find the nearest hit of a ray, or whether it hits anything.

There is one interface (:class:`~torchpt.search.base.Accel`: start there) with three backends, named as in the key
``render.accel``:

- ``brute`` (CPU): brute force in packets of rays, by kernels of the lane compiler; for a few dozen primitives.
- ``numba`` (CPU): an eight-wide BVH built by the surface area heuristic (``tree_build.py``, ``tree_layout.py``), traversed by
  packets and single rays (``tree.py``). Its kernels were lowered by numba (``scripts/kernel_sources``), hence the name; the
  package carries them as LLVM IR (:mod:`torchpt.native.kernels`).
- ``torch`` (any device, the reference): a linear BVH built and traversed by tensor operations (``lbvh.py``).

Instances of meshes are a second level above the last two (``instances.py``, ``tree_instances.py``).

May import: ``compiler`` and the packages below it; of ``physics`` only ``shapes.geometry``.
"""

from __future__ import annotations

from torchpt.core.errors import SceneError
from torchpt.physics.shapes.geometry import Geometry
from torchpt.search.base import Accel, Hits

__all__ = ["BRUTE_LIMIT", "KINDS", "Accel", "Hits", "brute_if_fastest", "build"]

#: Values of ``kind`` in :func:`build`: the backends, and ``auto``, which chooses one.
KINDS = ("auto", "torch", "numba", "brute")
#: Most primitives for which ``auto`` chooses ``brute`` on a CPU (measured crossover, scripts/bench_accel.py).
BRUTE_LIMIT = 128


def build(geometry: Geometry, kind: str = "auto", threads: int | None = None, before: Accel | None = None) -> Accel:
    """Build an acceleration structure, or refit one of the same primitives at other positions.

    Args:
        geometry: the primitives, on the device of the rays.
        kind: ``auto``, ``torch``, ``numba`` or ``brute``.
        threads: CPU threads of ``numba`` and ``brute``; None: torch's number. Results do not depend on it.
        before: an earlier structure of these primitives, which is refitted if it is of the chosen kind. It is not changed.

    Returns:
        The structure. ``auto`` chooses ``torch`` on an accelerator; on a CPU ``brute`` for few primitives of similar scale
        without quadrics, else ``numba``.

    Raises:
        SceneError: the kind is unknown, or does not support this geometry.
    """
    if kind not in KINDS:
        raise SceneError("render.accel", kind, " | ".join(KINDS))
    on_cpu = geometry.p0.device.type == "cpu"
    if geometry.copies is not None and kind == "brute":
        raise SceneError("render.accel", kind, "numba or torch (this scene has instances)")
    if kind == "auto":
        brute = brute_if_fastest(geometry, threads) if on_cpu else None
        if brute is not None:
            return brute
        kind = "numba" if on_cpu else "torch"
    if before is not None and before.name == kind:
        refitted = before.refit(geometry, threads)
        if refitted is not None:
            return refitted
    if kind == "torch":
        from torchpt.search.instances import Instanced
        from torchpt.search.lbvh import Lbvh

        return Lbvh(geometry) if geometry.copies is None else Instanced(geometry, Lbvh(geometry))
    if not on_cpu:
        raise SceneError("render.accel", kind, f"torch (this scene is on {geometry.p0.device.type})")
    if kind == "brute":
        from torchpt.search.brute import Brute

        return Brute(geometry, threads)
    if geometry.copies is not None:
        from torchpt.search.tree_instances import InstancedWideBvh

        return InstancedWideBvh(geometry, threads)
    from torchpt.search.tree import WideBvh

    return WideBvh(geometry, threads)


def brute_if_fastest(geometry: Geometry, threads: int | None = None) -> Accel | None:
    """Return the brute-force search; None if a tree is faster, or if float32 rows are too coarse for these primitives."""
    *_, quadrics = geometry.counts
    # Brute force tests quadrics outside of its packets: with three of them the tree is as fast already.
    if geometry.size > BRUTE_LIMIT or geometry.copies is not None or quadrics:
        return None
    from torchpt.search.brute import Brute, rows_of

    rows = rows_of(geometry)
    return Brute(geometry, threads, rows) if rows.is_precise else None
