"""Waves on a CPU as compiled loops: a thread takes a chunk of lanes through all of its path.

The stages are the same tensor functions that run eagerly; :mod:`torchpt.compiler` makes kernels of them. Between two kernels of
a chunk there is neither an operator of torch nor a barrier between threads.

=================  =======================================================================================
``threads.py``     which thread takes which chunk, and how samples add up to a picture: start here
``engine.py``      the engine of a thread: the events of a walk by kernels, how they are called, what rays meet
``programs.py``    the kernels of a render, made when they are first asked for, and shared by structure
``stages.py``      how the stages are traced: camera rays, search, emission, bounce, ends, layers, the film
``layout.py``      what a path carries, and where; loads, stores and lists that traces have in common
``backward.py``    the same for path replay
=================  =======================================================================================
"""
