"""Browser page with all images of a dataset, or with the predictions of a detector on it.

`collection` has the images to show, `documents` the JSON documents for the page, `pictures` the image files. `server`
answers the browser; viewer.html, .css and .js are the page.
"""
