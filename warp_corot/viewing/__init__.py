"""The page: a simulation in a browser, and a person's hands on it.

``session`` steps and does not depend on browsers; ``page`` shows a session with viser; ``gate`` decides who may enter.
"""
