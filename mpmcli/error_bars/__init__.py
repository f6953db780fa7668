"""The error of any scene without a known answer: it is computed again with what must not matter changed."""
