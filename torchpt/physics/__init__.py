"""Physics: BSDFs, lights, shapes, textures, cameras, samplers, the film, image-based lighting.

Pure functions of whole tensors: lanes are the last axis, vectors are ``(3, N)``. They depend on no engine, search, file format
or scene; an engine may replace functions that are :func:`~torchpt.core.dispatch.dispatched`. Each package has a base class in
``base.py``, kinds (one a file in ``kinds/``) and its records. ``world.py`` is the record of all tensors that stages read,
``parts.py`` has the records of shapes and parameters before they become tensors.

What may be imported: ``core``, ``native``, ``math``, ``spec``, ``images``. Start with ``bsdfs/kinds/diffuse.py``.
"""
