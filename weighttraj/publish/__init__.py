"""Data sets as pages to look at. Needs the extra ``report``.

``weighttraj.publish.report.report`` writes the page; without the extra ``sb3`` it has no film.
"""

from weighttraj.errors import needs

with needs("report"):
    import jinja2 as _jinja2
    import matplotlib as _matplotlib
    import PIL as _PIL

del _PIL, _jinja2, _matplotlib
