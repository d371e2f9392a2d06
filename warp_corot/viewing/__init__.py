"""The page: a simulation in a browser, and a person's hands on it.

``session`` steps and does not depend on browsers; ``messages`` tell browsers what it shows, and ``commands`` do what
they ask for. ``server`` brings both to them, ``access_control`` decides who may enter, and ``page/`` is what they load.
"""
