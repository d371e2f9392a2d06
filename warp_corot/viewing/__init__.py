"""The page: a simulation in a browser, and a person's hands on it.

``session`` steps and knows nothing of browsers; ``page`` shows a session with viser; ``gate`` says who may come in.
"""
