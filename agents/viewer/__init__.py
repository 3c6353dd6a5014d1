"""``ae-env view``: a scene at any settings, its scores and episodes of policies, in the browser.

`server` serves `page` and its three tabs, which show a `viewed_scene`, or the `judge_page`.
"""
