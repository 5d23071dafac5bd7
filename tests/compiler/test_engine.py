"""The cache of machine code: what is kept, what is trusted, and what is made again."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
from forms import one_lane

from torchpt.compiler import cache as shelf
from torchpt.compiler import cpu
from torchpt.compiler.target import Target
from torchpt.native import cache

pytestmark = pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners and modes of files here")

#: Two kernels; the numbers that they give, how many were compiled and how many loaded.
_SCRIPT = """
import torch
from torchpt.compiler import cpu
from torchpt.compiler.function import compile_lanewise
x = torch.arange(4.0)
functions = (lambda x: [x * 2 + 1]), (lambda x: [x.exp() > 3])
found = [compile_lanewise(function, [x])(x)[0].tolist() for function in functions]
assert found == [[1, 3, 5, 7], [False, False, True, True]], found
print(*cpu.counts())
"""


def start(folder: Path | str, **environment: str) -> subprocess.Popen[str]:
    given = {**os.environ, "TORCHPT_CACHE": str(folder), **environment}
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, "-c", _SCRIPT], env=given, stdout=pipe, stderr=pipe, text=True)


def finish(process: subprocess.Popen[str]) -> tuple[int, int]:
    out, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    compiled, loaded = map(int, out.split())
    return compiled, loaded


def entries(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.o"))


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The engine of this process as if nothing had been asked of it, with a cache of its own; its folder."""
    folder = tmp_path / "kernels"
    monkeypatch.setenv("TORCHPT_CACHE", str(folder))
    monkeypatch.setattr(cpu, "_functions", {})
    monkeypatch.setattr(cpu, "_state", {**cpu._state, "compiled": 0, "loaded": 0})
    again()
    yield folder
    again()


def ir(k: int = 0) -> str:
    return f"define void @kernel(ptr %a, i64 %n) {{\n  store i64 {k}, ptr %a\n  ret void\n}}\n"


def again() -> None:
    """Forget what this process has loaded, as a new one would."""
    cpu._functions.clear()
    cache._folder.cache_clear()
    cache._remove_old_entries.cache_clear()


@pytest.mark.slow
def test_second_process_compiles_nothing(tmp_path):
    folder = tmp_path / "deep" / "kernels"
    assert finish(start(folder)) == (2, 0)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert len(entries(folder)) == 2 and len(list(folder.iterdir())) <= 3  # the third: LLVM's name of the CPU
    assert all(stat.S_IMODE(path.stat().st_mode) == 0o600 for path in entries(folder))
    before = [(path.name, path.stat().st_mtime_ns) for path in entries(folder)]
    assert finish(start(folder)) == (0, 2)
    assert [(path.name, path.stat().st_mtime_ns) for path in entries(folder)] == before


@pytest.mark.slow
def test_two_processes_at_once(tmp_path):
    processes = [start(tmp_path / "kernels") for _ in range(2)]
    assert all(sum(finish(process)) == 2 for process in processes)
    assert not list((tmp_path / "kernels").glob("unfinished-*")) and len(entries(tmp_path / "kernels")) == 2
    assert finish(start(tmp_path / "kernels")) == (0, 2)


def test_within_a_process_a_kernel_is_made_once(here):
    first = cpu.compile_ir(ir())
    assert cpu.compile_ir(ir()) is first and cpu.counts() == (1, 0)
    again()
    assert cpu.compile_ir(ir()).code == first.code and cpu.counts() == (1, 1)
    cpu.compile_ir(ir(1))
    assert cpu.counts() == (2, 1)


def test_targets_have_entries_of_their_own(here):
    cpu.compile_ir(ir(), Target("generic", ""))
    cpu.compile_ir(ir())
    cpu.compile_ir(ir(), one_lane())  # another form
    assert cpu.counts() == (3, 0) and len(entries(here)) == 3


def test_forms_have_programs_of_their_own(monkeypatch):
    vectors = shelf.cache_key(("stage",))
    monkeypatch.setitem(cpu._state, "host", one_lane())
    assert vectors is not None and shelf.cache_key(("stage",)) not in (vectors, None)


def test_switched_off(here, monkeypatch):
    monkeypatch.setenv("TORCHPT_CACHE", "")
    assert cache.cache_folder() is None
    cpu.compile_ir(ir())
    again()
    cpu.compile_ir(ir())
    assert cpu.counts() == (2, 0) and not here.exists()


@pytest.mark.parametrize("mode", [0o755, 0o770, 0o701, 0o720])
def test_folder_that_others_may_enter(here, mode):
    here.mkdir()
    here.chmod(mode)
    assert cache.cache_folder() is None
    cpu.compile_ir(ir())
    assert cpu.counts() == (1, 0) and not entries(here)


def test_no_folder_can_be_made(here, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "file" / "kernels"):
        monkeypatch.setenv("TORCHPT_CACHE", str(place))
        again()
        assert cache.cache_folder() is None
        cpu.compile_ir(ir())
    assert cpu.counts() == (2, 0)


def test_folder_that_cannot_be_written(here):
    cpu.compile_ir(ir())
    again()
    here.chmod(0o500)
    try:
        cpu.compile_ir(ir())
        assert cpu.counts() == (1, 1)  # what is there is used
        cpu.compile_ir(ir(1))
        assert cpu.counts() == (2, 1)  # and what is not is compiled
    finally:
        here.chmod(0o700)


def test_disk_full(here, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    cpu.compile_ir(ir())
    assert cpu.counts() == (1, 0) and not list(here.iterdir())  # the temporary file is gone


@pytest.mark.parametrize("what", ["flipped", "truncated", "empty", "another's", "folder", "writable", "link", "pipe"])
def test_damaged_entries_are_made_again(here, what):
    code = cpu.compile_ir(ir()).code
    (path,) = entries(here)
    content = path.read_bytes()
    if what == "flipped":
        path.write_bytes(content[:-5] + bytes([content[-5] ^ 1]) + content[-4:])
    elif what == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif what == "empty":
        path.write_bytes(b"")
    elif what == "another's":  # a sound entry under another's name
        cpu.compile_ir(ir(1))
        path.write_bytes(next(other for other in entries(here) if other != path).read_bytes())
    elif what == "folder":
        path.unlink()
        path.mkdir()
    elif what == "pipe":  # to which nobody writes
        path.unlink()
        os.mkfifo(path)
    elif what == "writable":
        path.chmod(0o666)
    else:
        path.rename(here / "elsewhere")
        path.symlink_to(here / "elsewhere")
    again()
    compiled, loaded = cpu.counts()
    assert cpu.compile_ir(ir()).code == code
    assert cpu.counts() == (compiled + 1, loaded)
    if what != "folder":
        assert path.read_bytes() == content and not path.is_symlink() and stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root can give files away")
@pytest.mark.parametrize("what", ["folder", "entry", "link"])
def test_owner(here, tmp_path, what):
    cpu.compile_ir(ir())
    (path,) = entries(here)
    again()
    if what == "link":
        here.rename(tmp_path / "elsewhere")
        here.symlink_to(tmp_path / "elsewhere")
        assert cache.cache_folder() == here  # this user's own link to this user's own folder
        os.chown(here, 12345, 12345, follow_symlinks=False)
    else:
        os.chown(here if what == "folder" else path, 12345, 12345)
    assert (cache.cache_folder() is None) == (what != "entry")
    cpu.compile_ir(ir())
    assert cpu.counts() == (2, 0)


def test_places(tmp_path, monkeypatch):
    monkeypatch.delenv("TORCHPT_CACHE", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert cache.cache_folder() == tmp_path / "cache" / "torchpt" / "kernels"
    monkeypatch.chdir(tmp_path)
    for relative in ("", "cache"):  # not a path to rely on
        monkeypatch.setenv("XDG_CACHE_HOME", relative)
        assert cache.cache_folder() == tmp_path / "home" / ".cache" / "torchpt" / "kernels"
    monkeypatch.setenv("TORCHPT_CACHE", "own")
    assert cache.cache_folder() == tmp_path / "own"


def test_an_error_of_llvm_is_not_kept(here):
    with pytest.raises(RuntimeError, match="parsing"):
        cpu.compile_ir("define void @kernel(")
    assert cpu.counts() == (0, 0) and not entries(here)


# -- how much is kept


def kept(here: Path, names: list[str], days: float, size: int = 100) -> None:
    """Files of a size that were last used some days ago."""
    here.mkdir(mode=0o700, exist_ok=True)
    for k, name in enumerate(names):
        (here / name).write_bytes(bytes(size))
        used = time.time() - (days * 86_400.0) - 10.0 * (len(names) - k)
        os.utime(here / name, (used, used))


def test_what_was_not_used_for_long_goes_first(here, monkeypatch):
    monkeypatch.setattr(cache, "MOST", 1_000)
    old, new = [f"{k:040x}.o" for k in range(8)], [f"{k:040x}.json" for k in range(3)]
    kept(here, old, days=3.0)
    kept(here, new, days=0.0)
    kept(here, ["notes.txt", "unfinished-a"], days=9.0, size=0)
    kept(here, ["unfinished-b"], days=0.0, size=0)
    (here / "folder").mkdir()
    cache.write(f"{99:040x}.o", b"code")
    left = {path.name for path in here.iterdir()}
    # Of eleven hundred bytes five hundred stay; what a killed process left is gone, what is nobody's and what is new is not.
    assert left == {*old[6:], *new, "notes.txt", "unfinished-b", "folder", f"{99:040x}.o"}
    assert cache.read(f"{99:040x}.o") == b"code"


def test_nothing_goes_while_there_is_room(here, monkeypatch):
    monkeypatch.setattr(cache, "MOST", 1_000)
    names = [f"{k:040x}.o" for k in range(10)]
    kept(here, names, days=99.0)
    cache.write(f"{99:040x}.o", b"")
    assert {path.name for path in here.iterdir()} == {*names, f"{99:040x}.o"}
    cache.write(f"{98:040x}.o", bytes(5_000))  # looked at once a process
    assert len(list(here.iterdir())) == 12


def test_a_use_is_noted_once_a_day(here):
    cache.write(f"{1:040x}.o", b"code")
    path = here / f"{1:040x}.o"
    for hours, noted in ((1.0, False), (50.0, True)):
        before = time.time() - hours * 3600.0
        os.utime(path, (before, before))
        assert cache.read(path.name) == b"code"
        assert (path.stat().st_mtime > before + 1.0) == noted
