"""Whether a study run again comes to what its README says."""

import shutil

import pytest
from compare_readmes import differences, read_numbers, study_differences, text_differences

from warpfrag.studies.summary import BEGIN, END, Summary, SummaryError, Table


@pytest.mark.parametrize(
    ("regenerated", "lines"),
    [
        ({"error": 0.104, "found": 8}, []),
        ({"error": 0.12, "found": 8}, ["error: got 0.12, expected 0.1 within 5 %"]),
        ({"error": 0.1}, ["found: got none, expected 8"]),
        ({"error": 0.1, "found": 8, "new": 1.5}, ["new: got 1.5, expected no such number"]),
    ],
)
def test_numbers_differ(regenerated, lines):
    """A number that is missing, new or beyond the tolerance gets a line."""
    assert differences({"error": 0.1, "found": 8}, regenerated, 0.05) == lines


def test_floor_lets_rounding_be():
    """Where a number is 0 up to rounding, a floor says what does not matter."""
    assert differences({"error": 0.0}, {"error": 1e-9}, 0.05) != []
    assert differences({"error": 0.0}, {"error": 1e-9}, 0.05, floor=1e-8) == []


@pytest.mark.parametrize(
    ("committed", "regenerated", "same"),
    [
        ("PSNR 41.25 dB of 8", "PSNR 41.30 dB  of 8", True),
        ("PSNR 41.25 dB of 8", "PSNR 44.25 dB of 8", False),
        ("PSNR 41.25 dB", "SSIM 41.25 dB", False),
        ("one line", "one line\n\nand another", False),
        ("| a |  9.95 |\n|---|-----:|", "| a | 10.04 |\n| --- | ---: |", True),
        ("98 % in 3.2 s, 4 min", "98 % in 7.9 s, 9 min", True),
        ("30 steps/s", "60 steps/s", False),
        ("off by −0.5", "off by 0.5", False),
        ("pairs 2-3", "pairs 2-3", True),
        ("1e-06", "9e-07", True),
        ("1e-06", "4e-06", False),
        ("1,200,100 fragments", "1,199,900 fragments", True),
        ("1,200,100 fragments", "1,300,100 fragments", False),
        ("197 of 200", "198 of 200", True),
        ("7 of 8", "8 of 8", False),
    ],
)
def test_texts_differ(committed, regenerated, same):
    """Words are the same, numbers within tolerance or, if rounded, off by one in the last digit; times are free."""
    assert (text_differences(committed, regenerated, 0.01) == []) == same


def test_text_difference_names_the_line():
    """The message shows both numbers and the line they stand in."""
    (line,) = text_differences("PSNR 41.25 dB", "PSNR 31.25 dB", 0.01)
    assert line == 'text: got 31.25, expected 41.25 within 1 % in "PSNR 41.25 dB"'


@pytest.fixture
def folder(tmp_path):
    """A study's folder, saved."""
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "README.md").write_text(f"{BEGIN}\n{END}\n", encoding="utf-8")
    save(tmp_path / "a", 0.5)
    return tmp_path / "a"


def save(folder, error):
    """Save a study that has found an error."""
    table = Table(("scene", "error"), (("ball", error),))
    summary = Summary("a", "", "", f"The error is {error}.", tables=(table,), numbers={"error": error})
    summary.save(folder, results=folder / "results")


@pytest.mark.parametrize(("error", "count"), [(0.5, 0), (0.504, 0), (0.75, 3)])
def test_studies_differ(folder, tmp_path, error, count):
    """A copy in which the study was run again differs in its numbers and in each place of its README."""
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    save(copy, error)
    assert len(study_differences(folder, copy, 0.01)) == count


def test_readme_edited_by_hand_differs(folder, tmp_path):
    """A number changed in the README alone is found by running the study again."""
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    readme = folder / "README.md"
    readme.write_text(readme.read_text(encoding="utf-8").replace("error is 0.5", "error is 0.1"), encoding="utf-8")
    (line,) = study_differences(folder, copy, 0.01)
    assert "got 0.5, expected 0.1" in line


@pytest.mark.parametrize("content", [None, "", "[1]", '{"a": "b"}', '{"a": true}'])
def test_numbers_missing_or_damaged(tmp_path, content):
    """One line names the file."""
    if content is not None:
        (tmp_path / "numbers.json").write_text(content)
    with pytest.raises(SummaryError, match=r"numbers.json: got"):
        read_numbers(tmp_path)
