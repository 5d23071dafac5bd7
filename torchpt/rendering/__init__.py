"""One render: chunks of pixels, each a wave, accumulate in films.

===================  ===================================================================================
``api.py``           ``render`` and ``trace``, the one entry of the command line and of Python: start here
``orders.py``        one call of ``render``: checked, completed to settings, on a tape where gradients are wanted
``run.py``           one forward render: takes chunks, adds them up in films
``stopping.py``      how many samples are next, and what ends a render
``piece.py``         a piece of a pass by tensor operations, whole or not at all
``error.py``         pilots, and the rounds of adaptive sampling that they decide
``picture.py``       what a render comes to; ``result.py`` the picture with all that is known of it
``checkpoint.py``    what a render goes on from; ``split.py`` passes that several processes share
``many.py``          several renders at once; ``batches/`` many small pictures by one call
``one_path.py``      one path, vertex by vertex; ``causes.py`` what is said of samples that are not finite
``graphs.py``        ``render`` as operators in graphs of ``torch.compile``
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
