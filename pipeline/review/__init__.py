"""The one page that a reviewer opens, over all reports."""

from pipeline.review.render import PAGE, write_page

__all__ = ["PAGE", "write_page"]
