import matplotlib.image
import numpy as np

from drake_safety.evaluation.figure_style import save
from drake_safety.evaluation.roc_figure import roc_figure


def picture():
    label = np.array([False, True, True, False])
    return roc_figure({"scorer": (np.array([0.1, 0.9, 0.4, 0.5]), label)})


def test_a_picture_is_saved_as_png_and_svg_and_again_with_the_same_bits(tmp_path):
    png, svg = save(picture(), tmp_path / "new" / "roc.pdf")
    assert (png.name, svg.name) == ("roc.png", "roc.svg")
    assert matplotlib.image.imread(png).shape == (1000, 2000, 4)
    again = save(picture(), tmp_path / "again")
    assert svg.read_bytes() == again[1].read_bytes()
    assert png.read_bytes() == again[0].read_bytes()


def test_drawing_and_saving_leave_no_trace_in_the_reader_s_own_settings(tmp_path):
    before = dict(matplotlib.rcParams)
    save(picture(), tmp_path / "roc")
    assert dict(matplotlib.rcParams) == before
