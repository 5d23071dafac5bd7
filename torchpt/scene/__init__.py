"""From a scene file to what engines run: YAML -> description -> parts -> :class:`Scene` -> world and waves.

====================  ==================================================================================
``formats/``          the scene file, and the description that it comes to
``meshes/``           mesh files as triangles with their materials, lights and cameras
``settings.py``       the settings of a render, each declared once
``loading.py``        what ``torchpt.load`` does: start here
``build.py``          from a description to parts and parameters, with ``shapes.py``, ``sources.py``, ``mesh_shapes.py``
``scene.py``          a scene: its parameters, and what is made of them
``world/``            from parts and parameters to a world: one differentiable function
``prepare.py``        from a scene to what all waves of a render share, and which engine takes them
``conventions.py``    cameras of other libraries; ``transforms_json.py`` those of NeRF's files
====================  ==================================================================================

May import: ``engines`` and what lies below.
"""

from __future__ import annotations

from torchpt.scene.loading import load
from torchpt.scene.scene import Scene

__all__ = ["Scene", "load"]
