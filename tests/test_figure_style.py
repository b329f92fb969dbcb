import matplotlib.image

from drake_safety.evaluation.figure_style import drawing_style, new_figure, save


def picture():
    with drawing_style():
        figure = new_figure(10.0, 5.0)
        figure.subplots().plot([0.1, 0.9, 0.4])
    return figure


def test_a_picture_is_saved_as_png_and_svg_and_again_with_the_same_bits(tmp_path):
    before = dict(matplotlib.rcParams)
    png, svg = save(picture(), tmp_path / "new" / "curve.pdf")
    assert (png.name, svg.name) == ("curve.png", "curve.svg")
    assert matplotlib.image.imread(png).shape == (1000, 2000, 4)
    again = save(picture(), tmp_path / "again")
    assert svg.read_bytes() == again[1].read_bytes()
    assert png.read_bytes() == again[0].read_bytes()
    assert dict(matplotlib.rcParams) == before  # The reader's own settings.
