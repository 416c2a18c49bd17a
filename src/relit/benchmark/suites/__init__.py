"""The suites, one module each. A suite of another kind of capture is such a module and its line in
SUITES."""

from relit.benchmark.suites.collection import COLLECTION
from relit.benchmark.suites.duplicates import DUPLICATES
from relit.benchmark.suites.flash import FLASH
from relit.benchmark.suites.multiview import MULTIVIEW
from relit.benchmark.suites.phone import PHONE
from relit.benchmark.suites.registration import REGISTRATION
from relit.benchmark.suites.suite import Bar, Item, Suite, function_at
from relit.benchmark.suites.tabletop import EVERYDAY_SUITE, TURNTABLE_SUITE

SUITES: dict[str, Suite] = {
    "multiview": MULTIVIEW,
    "phone": PHONE,
    "everyday": EVERYDAY_SUITE,
    "turntable": TURNTABLE_SUITE,
    "flash": FLASH,
    "collection": COLLECTION,
    "duplicates": DUPLICATES,
    "registration": REGISTRATION,
}

__all__ = ["SUITES", "Bar", "Item", "Suite", "function_at"]
