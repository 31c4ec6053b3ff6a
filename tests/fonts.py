"""A font for the tests, with letters that the fonts of this machine may lack."""

from contextlib import contextmanager

from fontTools.fontBuilder import FontBuilder
from fontTools.pens.ttGlyphPen import TTGlyphPen
from matplotlib import font_manager

from envs import rendering

LETTERS = "去工作室"  # "go to the workshop"


def make(path):
    """Writes a font in which each of LETTERS is a rectangle, as wide as letters of East Asia are and each higher."""
    builder = FontBuilder(1000)
    names = [".notdef", *(f"letter{number}" for number in range(len(LETTERS)))]
    builder.setupGlyphOrder(names)
    builder.setupCharacterMap({ord(letter): name for letter, name in zip(LETTERS, names[1:], strict=True)})
    glyphs = {}
    for number, name in enumerate(names):
        pen = TTGlyphPen(None)
        corners = [(100, 0), (100, 150 * number), (900, 150 * number), (900, 0)]
        pen.moveTo(corners[0])
        for corner in corners[1:]:
            pen.lineTo(corner)
        pen.closePath()
        glyphs[name] = pen.glyph()
    builder.setupGlyf(glyphs)
    builder.setupHorizontalMetrics({name: (1000, 100) for name in names})
    builder.setupHorizontalHeader(ascent=800, descent=-200)
    builder.setupNameTable({"familyName": "Rectangles", "styleName": "Regular"})
    builder.setupOS2()
    builder.setupPost()
    builder.save(path)


@contextmanager
def installed(path):
    """In this context the only fonts of Matplotlib are its DejaVu Sans and the font with LETTERS, written to a path."""
    make(path)
    manager = font_manager.fontManager
    before = manager.ttflist
    manager.ttflist = [font for font in before if font.name.startswith("DejaVu Sans")]
    manager.addfont(path)
    rendering.find_font.cache_clear()
    try:
        yield
    finally:
        manager.ttflist = before
        rendering.find_font.cache_clear()
