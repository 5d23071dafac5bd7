"""Waves on a CPU as compiled loops: a thread takes a chunk of lanes through all of its path.

The stages are the same tensor functions that run eagerly; :mod:`torchpt.lanes` makes kernels of them. Between two kernels of
a chunk there is neither an operator of torch nor a barrier between threads.

======================  ==============================================================================
``schedule.py``         which thread takes which chunk, and how samples add up to a picture: start here
``spare.py``            engines of threads that no render has, kept for the next one
``chunk.py``            the engine of a thread: the events of a walk by kernels
``search.py``           what rays meet, where that is asked between kernels
``eager.py``            a vertex by tensor operations, for models that no kernel can be made of
``calls.py``            how a thread calls a kernel
``kernels.py``          the kernels of a render, made when they are first asked for
``vertex.py``           how the stages of paths are traced: camera rays, emission, bounce, ends
``packets.py``          the same for the search of few primitives
``transmission.py``     the same for rays through what lets them pass
``output.py``           the same for layers and the film
``trace.py``            what those functions have in common: loads, stores, lists
``layout.py, rows.py``  what a path carries, and where
``programs.py``         programs of this process; traced once for all scenes of a structure
``leaves.py``           the tensors that they read
======================  ==============================================================================
"""
