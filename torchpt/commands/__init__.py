"""What each command of `torchpt` does, its arguments being plain values. `torchpt.cli` is the command line."""
