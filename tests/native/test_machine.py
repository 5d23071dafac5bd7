"""LLVM's name of the CPU is cached, and asked for again where the CPU may be another."""

from __future__ import annotations

import pytest

from torchpt.native import cache, machine


@pytest.fixture
def asked(tmp_path, monkeypatch):
    """A list that grows each time LLVM is asked, with an empty cache."""
    monkeypatch.setenv("TORCHPT_CACHE", str(tmp_path))
    cache._folder.cache_clear()
    found: list[str] = []
    llvm = machine.llvm()

    class Asked:
        get_host_cpu_features = staticmethod(llvm.get_host_cpu_features)

        @staticmethod
        def get_host_cpu_name() -> str:
            found.append(llvm.get_host_cpu_name())
            return found[-1]

    monkeypatch.setattr(machine, "llvm", lambda: Asked)
    yield found
    cache._folder.cache_clear()


def test_the_cpu_is_asked_for_once_a_boot(asked, monkeypatch):
    host, boots = machine.host.__wrapped__, iter(("one", "one", "two", "two"))
    monkeypatch.setattr(machine, "_boot", lambda: next(boots))
    first = host()
    assert first == (asked[0], machine.llvm().get_host_cpu_features().flatten())
    assert [host(), host(), host()] == [first] * 3
    assert len(asked) == 2


def test_another_version_of_llvm_asks_again(asked, monkeypatch):
    monkeypatch.setattr(machine, "_boot", lambda: "one")
    machine.host.__wrapped__()
    monkeypatch.setattr(machine, "version", lambda: "0.0")
    machine.host.__wrapped__()
    assert len(asked) == 2


def test_without_a_description_nothing_is_kept(asked, monkeypatch, tmp_path):
    monkeypatch.setattr(machine, "_boot", lambda: None)
    assert machine.host.__wrapped__() == machine.host.__wrapped__()
    assert len(asked) == 2 and not list(tmp_path.iterdir())
