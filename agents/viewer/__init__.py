"""``ae-env view``: a scene at any settings, its scores and episodes of policies, in the browser.

`library` finds scenes, `viewed_scene` makes what is shown of one and `playing` the episodes in it;
`exposure_page` and `episode_page` put them on the page, and `server` serves that to one browser.
"""
