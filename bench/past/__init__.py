"""What a run that died has left in its record, and how a later process takes it up again.

`feeding` gives the recorded readings back to the protocol, `corners` finds what the specimen remembers of them, and
`repriming` brings the specimen there again.
"""

from bench.past.feeding import RESUMED, Fed, Past, feed
from bench.past.repriming import Resumption, reprime

__all__ = ["RESUMED", "Fed", "Past", "Resumption", "feed", "reprime"]
