"""One forward render: chunks of pixels, each a wave, accumulate in films.

``wave`` makes what all waves of a render share, ``schedule`` cuts the picture into chunks and passes, ``run`` takes them and
adds them up, ``kept`` is what renders of a scene leave for the next one.
"""
