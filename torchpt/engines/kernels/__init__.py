"""Compiled wavefront path tracing: a thread takes a chunk of lanes from the camera to the ends of all paths, or a GPU a wave.

The stages are the tensor functions that also run eagerly; :mod:`torchpt.compiler` compiles them to kernels. Between two kernels
of a chunk there is neither an operator of torch nor a barrier between threads.

======================  =====================================================================================
``threads.py``          tasks on threads, and adding samples to the film: start here
``engine.py``           the engine of one thread: the stages of a walk
``calls.py``            calls of kernels by one thread: counters, arguments
``searches.py``         searches of rays between stages, and behind surfaces that they pass
``eagerly.py``          a vertex by tensor operations, for BSDF models that cannot be compiled
``joins.py``            splats and connections: their shadow rays, and what they bring
``programs.py``         the kernels of a render, compiled on first use, and shared between renders
``stages.py``           the functions that trace kernels: camera rays, search, emission, bounce, layers, film
``layout.py``           rows of the path state in memory; loads, stores and lists that kernels share
``backward.py``         kernels and engine of path replay
``device.py``           the same stages on a CUDA device: waves, counts in memory, films
``device_backward.py``  path replay on a CUDA device
``device_sums.py``      its sums of gradients, in the order of a CPU
``driver.py``           the device's driver: loading code and launching kernels
======================  =====================================================================================
"""
