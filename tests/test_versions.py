"""What a run notes of the version that made it."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from torchrl_aca.training import report


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_the_commit_is_this_packages_and_not_that_of_a_repository_around_it(tmp_path, monkeypatch):
    def git(*arguments):
        own = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
        call = ["git", *own, *arguments]
        done = subprocess.run(call, cwd=tmp_path, check=True, capture_output=True, text=True)
        return done.stdout.strip()

    file = tmp_path / "site-packages" / "report.py"
    file.parent.mkdir()
    file.touch()
    (tmp_path / "theirs").touch()
    git("init", "-q")
    git("add", "theirs")
    git("commit", "-qm", "theirs")
    monkeypatch.setattr(report, "__file__", str(file))
    assert report.versions()["commit"] is None
    git("add", ".")
    git("commit", "-qm", "ours")
    assert report.versions()["commit"] == git("rev-parse", "HEAD")
    file.write_text("changed")
    assert report.versions()["commit"] == git("rev-parse", "HEAD") + "-dirty"
