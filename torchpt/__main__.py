"""Run the command line: ``python -m torchpt`` is ``torchpt``."""

from torchpt.cli.main import run

if __name__ == "__main__":
    run()
