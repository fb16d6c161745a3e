"""Files and folders appear whole or not at all."""

from pathlib import Path

import pytest

from scvi_codegen.common.atomic import replaced


def filled(folder: Path, text: str) -> Path:
    folder.mkdir()
    (folder / "part").write_text(text)
    return folder


@pytest.mark.parametrize("before", [False, True])
def test_folder_replaces_another(tmp_path: Path, before: bool) -> None:
    target = tmp_path / "run"
    if before:
        (filled(target, "old") / "old alone").write_text("")
    with replaced(target) as made:
        filled(made, "new")
    assert [file.name for file in target.iterdir()] == ["part"]
    assert (target / "part").read_text() == "new"
    assert [*tmp_path.iterdir()] == [target]


def test_old_folder_is_restored_if_the_new_one_cannot_be_moved(tmp_path: Path, monkeypatch) -> None:
    target = filled(tmp_path / "run", "old")
    move = Path.replace

    def refused(self: Path, to: Path) -> Path:
        if self.name == to.name:
            raise OSError("no")
        return move(self, to)

    monkeypatch.setattr(Path, "replace", refused)
    with pytest.raises(OSError, match="no"), replaced(target) as made:
        filled(made, "new")
    assert (target / "part").read_text() == "old"
    assert [*tmp_path.iterdir()] == [target]


def half_made(target: Path) -> None:
    with replaced(target) as made:
        filled(made, "half")
        raise RuntimeError


def test_incomplete_files_change_nothing(tmp_path: Path) -> None:
    target = filled(tmp_path / "run", "old")
    with pytest.raises(RuntimeError):
        half_made(target)
    assert (target / "part").read_text() == "old"
    assert [*tmp_path.iterdir()] == [target]
