"""The generated pages and pictures are current, and they name everything that the tables have."""

import dataclasses
from pathlib import Path
from xml.etree import ElementTree

import pytest

from common.comms.messages import MESSAGES
from common.service.config_sources import TABLES
from common.task.states import Outcome, State
from topspin.reference.files import FOLDER, files

PROJECT = Path(__file__).parents[4]


@pytest.mark.parametrize("name", sorted(files()))
def test_the_file_is_current(name):
    assert (PROJECT / FOLDER / name).read_text(encoding="utf-8") == files()[name], (
        "run: python -m topspin.reference"
    )


@pytest.mark.parametrize("name", [name for name in sorted(files()) if name.endswith(".svg")])
def test_a_picture_is_well_formed_and_its_text_stays_inside(name):
    root = ElementTree.fromstring(files()[name])
    width, height = (float(number) for number in root.get("viewBox").split()[2:])

    texts = [element for element in root.iter() if element.tag.endswith("text")]

    assert texts
    for text in texts:
        letters = 0.55 * float(text.get("font-size", "14")) * len(text.text)
        x = float(text.get("x")) - (letters / 2 if text.get("text-anchor") == "middle" else 0)
        assert x >= 0, text.text
        assert x + letters <= width, text.text
        assert 0 < float(text.get("y")) < height


def test_the_states_picture_has_every_outcome_of_a_touch():
    picture = files()["states.svg"]

    for outcome in set(Outcome) - {Outcome.NONE, Outcome.TIME_OUT}:
        assert f": {outcome.name.lower()}<" in picture
    for state in State:
        assert f"{state.name.lower()}" in picture


def test_the_protocol_page_has_every_message_and_field():
    page = files()["protocol.md"]

    for message in MESSAGES:
        section = page.partition(f"### {message.__name__}, version {message.VERSION}\n")[2].partition("###")[
            0
        ]
        for field in dataclasses.fields(message):
            assert f"| `{field.name}` |" in section
    assert "| `obs` | array `<f2` | as the observation | T B D | raw: the learner normalises |" in page
    assert "| `sequence` | integer | 1 |  | from 0 without a gap |" in page


def test_the_configuration_page_has_each_setting_once():
    page = files()["configuration.md"]

    sections = {part.partition("\n")[0]: part for part in page.split("\n## ")[1:]}

    assert {f"[{table}]" for table in TABLES} - sections.keys() == {"[bench]"}
    assert "| `launch` | `paper` |" in sections["[task]"]
    for name, section in sections.items():
        settings = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
        assert len(settings) == len(set(settings)), name
