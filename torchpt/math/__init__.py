"""Pure functions on tensors that know of no scene: vectors, frames, warps, distributions, MIS, microfacets, transforms.

Vectors are ``(3, N)``, lane scalars ``(N,)``. Start with ``vectors.py``. ``gathers.py`` is the one look-up in a table, which
gradients may follow.

May import: ``core``, ``native``.
"""
