"""``ae-env view``: a scene at any settings, its scores and episodes of policies, in the browser.

`library` finds scenes, `pictures` makes what is shown of one, `exposure_page` and `episode_page`
put it on the page, and `server` serves that to one browser.
"""
