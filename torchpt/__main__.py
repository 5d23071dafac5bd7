"""``python -m torchpt`` is ``torchpt``."""

from torchpt.cli import run

if __name__ == "__main__":
    run()
