"""Images into a case: from a folder, from DICOM and OpenIGTLink peers, from a live source, with the robot's pose.

It may import `journal` and `contents`, and nothing else of `case`. Each source is imported by its own module, so that
a folder needs no network library.
"""

from sightline.case.acquire.acquirer import Acquirer, News, Taken, Tell, news_of

__all__ = ["Acquirer", "News", "Taken", "Tell", "news_of"]
