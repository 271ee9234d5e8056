"""Tables of names as programs and people write them."""

from pathlib import Path

import pytest
from refusals import refused

from puncture_twin.planning.formats.labels.labelmaps import parse_names

NAMES = {1: "right lung", 7: "vein, portal"}


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("a.csv", 'id,name\n1,right lung\n\n7,"vein, portal"\n'),
        ("a.csv", 'label,name\n0,background\n1,right lung\n7,"vein, portal"\n'),
        ("a.csv", 'id,label\n1,right lung\n7,"vein, portal"\n'),
        ("a.csv", 'Name,Label Value,Color\nright lung,1,red\n"vein, portal",7,blue\n'),
        ("a.csv", 'LabelValue,Structure\n1,right lung\n7,"vein, portal"\n'),
        ("a.csv", 'index,class_name,volume\n1,right lung,3.2\n7,"vein, portal",4\n'),
        ("a.csv", "\ufeffvalue;name\r\n1;right lung\r\n7;vein, portal\r\n"),
        ("a.tsv", "label_id\torgan\n1\tright lung\n7\tvein, portal\n"),
        ("a.json", '{"1": "right lung", "7": "vein, portal"}'),
        ("a.json", '{"right lung": 1, "vein, portal": 7}'),
        ("a.json", '{"name": "x", "labels": {"background": 0, "right lung": 1, "vein, portal": 7}}'),
        ("a.json", '{"labels": {"0": "background", "1": "right lung", "7": "vein, portal"}}'),
        (
            "a.txt",
            '# ITK-SnAP Label Description File\n0 0 0 0 0 0 0 "Clear Label"\n1 255 0 0 1 1 1 "right lung"\n'
            ' 7   0 9 0        0.5  1  1    "vein, portal"\n',
        ),
        ("a.ctbl", '# Color table\n0 Background 0 0 0 0\n1 "right lung" 1 2 3 255\n7 "vein, portal" 1 2 3 255\n'),
    ],
)
def test_common_tables_are_read(file: str, text: str) -> None:
    """Whatever their columns are called, in whichever order."""
    assert parse_names(text.encode(), Path(file)) == NAMES


@pytest.mark.parametrize(
    ("file", "text", "match"),
    [
        ("a.csv", "1,liver\n", "wrong_columns"),
        ("a.csv", "name,colour\nliver,red\n", "wrong_columns"),
        ("a.csv", "name,name\nliver,1\n", "wrong_columns"),
        ("a.csv", "label,name\n0,liver\n", "bad_label"),
        ("a.csv", "label,name\n1,liver\n1,spleen\n", "duplicate_label"),
        ("a.csv", "label,name\n1.0,liver\n", "bad_label 1.0"),
        ("a.csv", "label,name\n99999,liver\n", "bad_label"),
        ("a.csv", "label,name\n1,liver,red\n", "ragged_row"),
        ("a.json", '{"1": "liver", "1": "spleen"}', "not_json"),
        ("a.json", '{"liver": [1, 2]}', "labels_of_regions"),
        ("a.json", '{"liver": {"a": 1}}', "wrong_format"),
        ("a.json", '{"liver": true}', "wrong_format"),
        ("a.json", '["liver"]', "wrong_format"),
        ("a.json", "{}", "empty"),
        ("a.txt", "1 liver\n", "unknown_line"),
        ("a.txt", '1 255 0 0 1 1 1 "liver\n', "unknown_line"),
        ("a.txt", "some notes about the patient and more\n", "unknown_line"),
    ],
)
def test_what_is_no_table_is_refused(file: str, text: str, match: str) -> None:
    """By line where there is one."""
    with refused(*match.split()):
        parse_names(text.encode(), Path(file))
