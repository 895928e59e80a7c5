"""``edoras samples``."""

import filecmp

from places import ROOT


def test_they_are_copies(call, tmp_path):
    folder = tmp_path / "new/samples"
    done = call("samples", folder)
    copied = {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}
    assert done.out.startswith(f"{folder}: {len(copied)} files; start with: edoras info ")
    assert len(copied) > 20
    assert all(filecmp.cmp(ROOT / "samples" / path, folder / path, shallow=False) for path in copied)
    assert call(*done.out.split("edoras ")[1].split()).code == 0


def test_a_folder_in_use_is_left_alone(call, tmp_path):
    (tmp_path / "notes").write_text("mine")
    done = call("samples", tmp_path)
    assert done.code == 2
    assert [path.name for path in tmp_path.iterdir()] == ["notes"]
    assert call("samples", tmp_path, "--force").code == 0
    assert (tmp_path / "notes").read_text() == "mine"


def test_a_folder_that_cannot_be_written(call, tmp_path):
    (tmp_path / "file").write_text("")
    done = call("samples", tmp_path / "file")
    assert done.code == 1
    assert len(done.err) == 1
