"""What is written in a matplotlib figure, and where."""

import re
import zlib
from contextlib import suppress
from itertools import combinations


def written(figure):
    """All words that a figure shows, with their bounding boxes in pixels."""
    from matplotlib.text import Annotation, Text

    figure.draw_without_rendering()
    renderer = figure.canvas.get_renderer()
    out = []
    beyond = {id(label) for label in _beyond(figure)}
    for text in figure.findobj(Text):
        if id(text) in beyond or not text.get_visible() or not text.get_text().strip():
            continue
        patch = text.get_bbox_patch()  # the words of an annotation have an arrow as well
        words = (
            patch if patch else super(Annotation, text) if isinstance(text, Annotation) else text
        )
        out.append((text.get_text(), words.get_window_extent(renderer)))
    return out


def _beyond(figure):
    """Labels of ticks beyond the limits of their axis: they exist and are not drawn."""
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
                if not low <= tick.get_loc() <= high:
                    yield from (tick.label1, tick.label2)


def overlaps(figure):
    """Pairs of words that cover each other by more than a pixel."""
    boxes = written(figure)
    return [
        (one, other)
        for (one, a), (other, b) in combinations(boxes, 2)
        if a.padded(-1.0).overlaps(b.padded(-1.0))
    ]


def smallest(figure):
    """Size of the smallest letters of a figure [points]."""
    from matplotlib.text import Text

    figure.draw_without_rendering()
    shown = (text for text in figure.findobj(Text) if text.get_text().strip())
    return min(text.get_fontsize() for text in shown)


def sizes_in_pdf(path):
    """Sizes of all letters in a PDF file [points], and its width [inch]."""
    content = path.read_bytes()
    width = float(re.search(rb"/MediaBox \[ ?0 0 ([\d.]+)", content)[1]) / 72.0
    sizes = []
    # what is compressed may itself end with a carriage return
    for stream in re.findall(rb"stream\r?\n(.*?)\nendstream", content, re.S):
        with suppress(zlib.error):
            drawn = zlib.decompress(stream)
            sizes += [float(size) for size in re.findall(rb"/F\S+ ([\d.]+) Tf", drawn)]
    return sizes, width


def cut_off(figure):
    """Words that do not lie on the canvas as a whole."""
    width, height = figure.bbox.size
    return [
        text
        for text, box in written(figure)
        if box.x0 < -1 or box.y0 < -1 or box.x1 > width + 1 or box.y1 > height + 1
    ]
