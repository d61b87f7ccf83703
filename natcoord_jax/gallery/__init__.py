"""The gallery: ready scenes for the command line, tests, benchmarks and notebooks.

Every entry of `SCENES` is a function without obligatory arguments that builds an `Example`; the first line
of its docstring says what it is.
"""
