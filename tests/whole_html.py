"""HTML as a notebook gets it: whole, and with nothing from outside."""

from html.parser import HTMLParser


class Whole(HTMLParser):
    """Complains where a tag is closed that is not the last one opened."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags = [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        """No part of it comes from outside, none acts."""
        if tag != "img":
            self.open.append(tag)
        self.tags.append(tag)
        assert not any(name in ("href", "onload", "onclick") for name, _ in attrs)
        assert all(value.startswith("data:") for name, value in attrs if name == "src")

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag
