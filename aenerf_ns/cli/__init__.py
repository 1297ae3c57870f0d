"""The commands of ``aenerf``: one dataclass each, with its options and ``main()``.

torch and the framework take seconds to import. Commands import them within functions, so that mistakes in the arguments
are reported at once.
"""
