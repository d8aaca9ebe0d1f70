"""The page to author with, as tests, the picture of the docs and the journey operate it."""


class Author:
    """The page, by what a person does on it."""

    def __init__(self, browser, address):
        self.browser = browser
        browser.problems.clear()
        browser.requests.clear()
        browser.call("Page.navigate", url=address)
        browser.until("document.querySelector('#author-name, #author-face p') !== null")
        browser.rest()

    def choose(self, *names):
        """Click faces in the list, the later ones with Ctrl."""
        for number, name in enumerate(names):
            self.browser.tell(
                f"[...document.querySelectorAll('[data-face]')].find((one) => one.textContent === {name!r})"
                f".dispatchEvent(new MouseEvent('click', {{bubbles: true, ctrlKey: {str(number > 0).lower()}}}))"
            )

    def type(self, selector, text):
        """Replace the text of a field by the keyboard, with Enter at its end."""
        self.browser.tell(f"(() => {{ const e = document.querySelector({selector!r}); e.focus(); e.select(); }})()")
        self.browser.call("Input.insertText", text=text)
        self.browser.press("Enter")

    def pick(self, selector, value):
        self.browser.tell(
            f"(() => {{ const e = document.querySelector({selector!r}); e.value = {value!r};"
            " e.dispatchEvent(new Event('change')); })()"
        )

    def measure(self, kind, tolerance):
        self.pick("#author-kind", kind)
        self.type("#author-tolerance", tolerance)

    def downloaded(self):
        """Texts of the files that the page offers on saving, the scene first, then the task."""
        self.browser.tell("window.kept = []; URL.createObjectURL = (blob) => { kept.push(blob); return 'blob:none'; }")
        self.browser.tell("document.getElementById('author-save').click()")
        return self.browser.tell("Promise.all(kept.map((one) => one.text()))")

    @property
    def says(self):
        return self.browser.tell("document.getElementById('author-status').textContent")

    def faces(self):
        return self.browser.tell("[...document.querySelectorAll('[data-face]')].map((one) => one.textContent)")
