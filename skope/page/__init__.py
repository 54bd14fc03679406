"""HTML pages and their common parts: templates, styles, scripts, drawings.

`templates` fills the HTML files, `svg` writes drawings, `charts` and `vehicle_outline` are drawings with their numbers
below, `image_viewer` has photographs with layers. The scripts of all pages share dom.js and viewport.js.
"""
