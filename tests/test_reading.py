from pathlib import Path

import pytest

from drake_safety.files.reading import parse_yaml, reading

BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "\n".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 9)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, "has more than 200000 values with its aliases"),
        ("a: &a [*a]", "has more than 200000 values with its aliases"),
        ("[" * 20000, "nested too deeply"),
        ("a: 1\nb: 2\na: 3", "^the text: key 'a' stands twice, in lines 1 and 3$"),
        ("z: &z {a: 1}\ny: &y {a: 2}\nx:\n  <<: *z\n  <<: *y", "key '<<' stands twice"),
    ],
)
def test_yaml_that_is_a_trap_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        parse_yaml(text, "the text")


def test_aliases_and_merged_keys_are_read():
    text = "z: &z {a: 1, b: 1}\nx: {y: &y {<<: *z, a: 2}}\nw: {<<: *y, b: 3}\nc: [*z, *z]"
    read = parse_yaml(text, "the text")
    assert (read["x"]["y"], read["w"]) == ({"a": 2, "b": 1}, {"a": 2, "b": 3})
    assert read["c"] == [{"a": 1, "b": 1}] * 2


def test_errors_gain_the_name_of_the_file_once_and_lose_their_length():
    path = Path("/there/file.csv")

    def message(error, errors=Exception):
        with pytest.raises(ValueError, match="file") as caught, reading(path, "log", errors):
            raise error
        return str(caught.value)

    assert message(ValueError("no columns")) == "log '/there/file.csv': no columns"
    assert message(KeyError("q")) == "log '/there/file.csv': KeyError: 'q'"
    own = f"log '{path}' has no columns"
    assert message(ValueError(own)) == own
    assert len(message(ValueError("x" * 5000))) < 700
    with pytest.raises(KeyError), reading(path):
        raise KeyError("q")
    with pytest.raises(FileNotFoundError), reading(path, "log", Exception):
        path.read_text()
