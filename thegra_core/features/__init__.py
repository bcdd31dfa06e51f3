"""The learned front end: extractors, matchers, their weights."""

import sys

if sys.version_info < (3, 11):
    from thegra_core.features.python310 import prepare

    prepare()
