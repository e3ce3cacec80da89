"""Data sets as pages to look at. Needs the extra ``report``.

``weighttraj.publish.report.report`` writes the page; without the extra ``sb3`` it has no film.
"""

from weighttraj.errors import missing_extra

try:
    import jinja2 as _jinja2
    import matplotlib as _matplotlib
    import PIL as _PIL
except ModuleNotFoundError as error:
    raise missing_extra(str(error.name), "report") from error

del _PIL, _jinja2, _matplotlib
