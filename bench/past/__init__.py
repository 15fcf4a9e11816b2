"""What a run that died has left in its record, and how a later process takes it up again.

`feeding` gives the recorded readings back to the protocol, `corners` finds what the specimen remembers of them, and
`repriming` brings the specimen there again; `interrupted` is the whole, as `bench.runs` takes it up.
"""

from bench.past.feeding import Fed, Past, feed
from bench.past.interrupted import Interrupted
from bench.past.repriming import RESUMED, Resumption, reprime

__all__ = ["RESUMED", "Fed", "Interrupted", "Past", "Resumption", "feed", "reprime"]
