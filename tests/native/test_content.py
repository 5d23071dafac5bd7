"""Digests of the code of a folder."""

from __future__ import annotations

import pytest

from torchpt.native import cache, content
from torchpt.native.content import code_of_folder


def test_code_of_a_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHPT_CACHE", str(tmp_path / "cache"))
    cache._folder.cache_clear()
    root = tmp_path / "package"
    (root / "inner").mkdir(parents=True)
    file = root / "inner" / "a.py"

    def code(text: str) -> str:
        file.write_text(text)
        code_of_folder.cache_clear()
        return code_of_folder(root)

    first = code("def f(x):\n    'Say.'\n    return x in {'a', 'b'}\n")
    assert code("# more\ndef f(x):\n    'Say more.'\n\n    return x in {'a', 'b'}\n") == first
    assert code("def f(x):\n    'Say.'\n    return x in {'a', 'c'}\n") != first
    assert code("def f(y):\n    'Say.'\n    return y in {'a', 'b'}\n") != first
    (root / "b.py").write_text("")
    assert code("def f(x):\n    'Say.'\n    return x in {'a', 'b'}\n") != first
    code_of_folder.cache_clear()
    cache._folder.cache_clear()


def test_files_that_did_not_change_are_not_read(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHPT_CACHE", str(tmp_path / "cache"))
    cache._folder.cache_clear()
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "a.py").write_text("x = 1\n")
    code_of_folder.cache_clear()
    first = code_of_folder(tmp_path / "package")
    monkeypatch.setattr(content, "_digest_of_file", lambda path: pytest.fail("read"))
    code_of_folder.cache_clear()
    assert code_of_folder(tmp_path / "package") == first
    code_of_folder.cache_clear()
    cache._folder.cache_clear()
