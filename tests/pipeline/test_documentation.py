"""Documentation: relative links refer to existing files and headings, and command lines are valid."""

import json
import re
import shlex
from functools import cache
from pathlib import Path

import pytest

from ngff_cli.app import app
from ngff_cli.lab import app as lab_app
from stages.core.models.checkpoints import SHIPPED
from tests.pipeline.test_commands import ROOT

PATTERNS = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "stages/**/README.md", "stages/lab/results/*.md")
PAGES = sorted(page for pattern in PATTERNS for page in ROOT.glob(pattern))
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```.*?^```", re.M | re.S)
INDENTED = re.compile(r"^(?: {4}|\t)(.*)$", re.M)
INLINE = re.compile(r"`([^`]+)`", re.S)
WORD_CHARACTERS = re.compile(r"[^\w\- ]")
PLACEHOLDER = re.compile(r"[A-Z_]+|\.\.\.")  # can stand for any command


@cache
def anchors(page: Path) -> set[str]:
    """Anchors of the headings of a page, computed as by GitHub."""
    text = FENCE.sub("", page.read_text())
    headings = re.findall(r"^#+ (.*)$", text, re.M)
    return {WORD_CHARACTERS.sub("", h.replace("`", "").strip().lower()).replace(" ", "-") for h in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(page):
    for target in LINK.findall(FENCE.sub("", page.read_text())):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = page.parent / name if name else page
        assert file.exists(), f"{page.name}: {target}: no such file"
        assert not anchor or anchor in anchors(file), f"{page.name}: {target}: no such heading"


@cache
def commands() -> dict:
    """The click group of each script."""
    from typer.main import get_command

    return {"ngff": get_command(app), "ngff-lab": get_command(lab_app)}


def command_lines(text: str) -> list[str]:
    """Lines in code blocks that start with `ngff` or `ngff-lab`, and inline code that does."""
    blocks = FENCE.findall(text)
    lines = [line for block in blocks for line in re.sub(r"\\\n\s*", " ", block).splitlines()]
    rest = FENCE.sub("", text)
    lines += INDENTED.findall(rest)
    lines += [" ".join(code.split()) for code in INLINE.findall(rest)]
    lines = [part.strip() for line in lines for part in line.strip().removeprefix("$ ").split(";")]
    return [line for line in lines if re.match(r"ngff(-lab)?\s", line)]


def unknown_part(line: str) -> str | None:
    """The first command or option of a command line that does not exist."""
    words = shlex.split(line.split(" #")[0].split(" > ")[0].split(" | ")[0])
    command, words = commands()[words[0]], words[1:]
    while words:
        word, words = words[0], words[1:]
        name = word.split("=")[0].rstrip(",")
        if name.startswith("-") and not re.fullmatch(r"-?\d.*", name):
            known = {option: p for p in command.params for option in (*p.opts, *p.secondary_opts)} | {"--help": None}
            if name not in known:
                return name
            option = known[name]
            if option is not None and "=" not in word and not option.is_flag and words:
                words = words[1:]
        elif hasattr(command, "commands"):
            if PLACEHOLDER.fullmatch(name) or "/" in name:  # "simulate/render" occurs in prose
                return None
            if name not in command.commands:
                return name
            command = command.commands[name]
    return None


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_command_lines_exist(page):
    for line in command_lines(page.read_text()):
        unknown = unknown_part(line)
        assert unknown is None, f"{page.name}: `{line}`: there is no {unknown}"


def test_recipe_of_the_shipped_weights_consists_of_commands():
    recipe = json.loads((SHIPPED / "ngff.json").read_text())["recipe"]
    made = {"ds"}
    for line in recipe:
        assert unknown_part(line) is None and line.startswith("ngff-lab "), line
        words = shlex.split(line)
        # inputs must be made by earlier lines
        assert {w for w in words if w.endswith(".safetensors")} - {words[-1]} <= made, line
        made.add(words[-1])
    assert words[-1] == "ngff.safetensors"


def test_wrong_command_lines_are_detected():
    assert unknown_part("ngff simulate scene.ply --steps 80 -o t.h5") is None
    assert unknown_part("ngff simulate scene.ply --stepps 80") == "--stepps"
    assert unknown_part("ngff imagine scene.ply") == "imagine"
    assert unknown_part("ngff-lab bench mpm --frames 5") is None
    assert unknown_part("ngff-lab bench mpm --frame 5") == "--frame"
    assert command_lines("Run\n\n    ngff render t.h5 \n\nor `ngff render t.h5\n--ids`.") == [
        "ngff render t.h5", "ngff render t.h5 --ids",
    ]  # fmt: skip
