"""Hand-written derivatives that override derived ones where speed matters; the tests hold each equal to the derived."""
