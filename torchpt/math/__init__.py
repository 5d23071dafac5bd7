"""Mathematics on tensors, independent of scenes: vectors, frames, warps, distributions, MIS, microfacets, transforms, sums.

Vectors are ``(3, N)``, scalars ``(N,)``. Start with ``vectors.py``. ``gathers.py`` lets a backward pass record look-ups in
tables.

May import: ``core``, ``native``.
"""
