"""What a page of HTML holds, for tests that write one."""

from html.parser import HTMLParser

VOID = {"meta", "img", "source", "br", "link", "input", "hr"}


class Outline(HTMLParser):
    """Collects texts, attributes, and unbalanced tags."""

    def __init__(self):
        super().__init__()
        self.open, self.texts, self.sources, self.headings = [], [], [], []
        self.elements = []

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, *sorted(name for name, _ in attrs)))
        if tag not in VOID:
            self.open.append(tag)
        self.sources += [value for key, value in attrs if key in ("src", "srcset", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)
        if data.strip() and "style" not in self.open:
            self.texts.append(data.strip())


def read(page):
    outline = Outline()
    outline.feed(page.read_text(encoding="utf-8"))
    assert outline.open == []
    return outline
