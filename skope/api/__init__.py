"""The functions and classes of `import skope`: datasets, the detector, footage, metres, traffic, cameras, training and
scores.

Each function loads what it needs when it is called, so that reading a dataset does not wait for torch. What is wrong
with a user's files or arguments raises a `skope.UserError` of one line that names file or argument.
"""
