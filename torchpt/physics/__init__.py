"""Physics: materials, lights, shapes, textures, cameras, samplers, the film, image-based lighting.

Pure functions of whole tensors: lanes are the last axis, vectors are ``(3, N)``. They know no engine, no search, no file format
and no scene; an engine may take over a function that is :func:`~torchpt.core.dispatch.dispatched`. Each room has its base, its
kinds (one a file in ``kinds/``) and the records that belong to it. ``world.py`` is the record of all tensors of a scene that
stages read, ``parts.py`` what shapes come to before they are tensors.

What may be imported: ``core``, ``native``, ``math``, ``spec``, ``images``. Start with ``bsdfs/kinds/diffuse.py``.
"""
