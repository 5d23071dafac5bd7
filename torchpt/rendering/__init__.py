"""One render, from the arguments of a call to a finished picture.

===================  ===================================================================================
``api.py``           ``render`` and ``trace``, the one entry of the command line and of Python: start here
``renderer.py``      a scene and its settings, decided once for many calls
``requests.py``      one call of ``render``: arguments checked and completed to settings, autograd where gradients are needed
``run.py``           one forward render: samples chunks and accumulates them in films
``stopping.py``      stop rules, and the number of samples of the next pass
``error.py``         error probes, and adaptive sampling that is guided by them
``picture.py``       makes a ``Rendering`` of the films; ``result.py`` that class: picture, AOVs, error, counts, seconds
``missing_light.py`` light that no sample found, for which there is no error estimate
``checkpoint.py``    saves and resumes a render; ``split.py`` shares a pass among ranks
``many.py``          several renders on one thread pool; ``batches/`` scenes by cameras in one call
``one_path.py``      prints one path vertex by vertex; ``nonfinite.py`` counts non-finite samples by cause
``forward_layers.py`` layers in forward mode, which have no derivatives there
``graphs.py``        ``render`` as a custom operator for ``torch.compile``
===================  ===================================================================================

May import: ``gradients`` and what lies below. (It is not called ``render``: that name is the function's.)
"""

from __future__ import annotations

from torchpt.rendering.many import QueuedRender, render_many
from torchpt.rendering.result import Progress, Rendering
from torchpt.rendering.run import Run, render_scene
from torchpt.scene.prepare import (
    SceneCache,
    describe_engine,
    kernels_of,
    make_wave,
    rebuild_with_tape,
    scene_cache,
    uses_kernels,
)

__all__ = [
    "Progress",
    "QueuedRender",
    "Rendering",
    "Run",
    "SceneCache",
    "describe_engine",
    "kernels_of",
    "make_wave",
    "rebuild_with_tape",
    "render_many",
    "render_scene",
    "scene_cache",
    "uses_kernels",
]
