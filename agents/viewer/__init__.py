"""``ae-env view``: a scene at any settings, its scores and episodes of policies, in the browser.

`viewed_scene` finds scenes and makes what is shown of one, `exposure_page`, `episode_page` and
`one_raw_page` are the tabs of `page`, and `server` serves it, or `judge_page`, to one browser.
"""
