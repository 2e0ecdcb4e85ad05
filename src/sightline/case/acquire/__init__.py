"""Acquisition of images into a case: from a folder, DICOM and OpenIGTLink peers, a live source, with the robot's pose.

It may import `journal` and `contents`, and nothing else of `case`. Each source has a module of its own, so that reading
a folder imports no network library.
"""

from sightline.case.acquire.acquirer import Acquirer, News, Taken, Tell, news_of

__all__ = ["Acquirer", "News", "Taken", "Tell", "news_of"]
