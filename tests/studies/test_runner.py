"""The numbers in the READMEs of studies are those that their commands write."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from compare_readmes import study_differences

ROOT = Path(__file__).parents[2]
# Another processor rounds otherwise in the last digit, and a fit stops where it may.
TOLERANCE = 0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", ["zfighting", "antialiasing"])
def test_study_writes_the_numbers_in_its_readme(tmp_path, name):
    """A study that is run again comes to the committed numbers and words, within tolerance."""
    copy = tmp_path / "experiments" / "fit" / name
    shutil.copytree(ROOT / "experiments" / "fit" / name, copy)
    shutil.copytree(ROOT / "scenes", tmp_path / "scenes")
    done = subprocess.run(
        [sys.executable, str(copy / "study.py")], cwd=tmp_path, capture_output=True, text=True, timeout=1200
    )
    assert done.returncode == 0, done.stderr
    assert study_differences(ROOT / "experiments" / "fit" / name, copy, TOLERANCE) == []


def test_every_study_is_whole():
    """Each folder has its study file, its script, figures, a README with the command, and the numbers it wrote."""
    folders = sorted(path.parent for path in (ROOT / "experiments" / "fit").glob("*/study.py"))
    assert len(folders) == 7
    for folder in folders:
        text = (folder / "README.md").read_text()
        assert f"uv run python experiments/fit/{folder.name}/study.py" in text
        assert (folder / "study.toml").is_file()
        assert (folder / "numbers.json").is_file()
        pictures = sorted((folder / "figures").glob("*.png"))
        assert pictures
        for picture in pictures:
            assert f"figures/{picture.name}" in text
