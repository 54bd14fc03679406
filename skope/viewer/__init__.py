"""A page in the browser that goes through all images of a dataset, or of what a detector found in it.

`collection` is what is looked at, `documents` the JSON that the page asks for, `pictures` the images' bytes, `server`
answers the browser, and viewer.html, .css and .js are the page.
"""
