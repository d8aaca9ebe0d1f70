"""The talk "Task Specific Viewpoint Optimisation" (Kinnell and Justham, 2018), made again: every figure and claim.

Signal chain: talk TOML (:mod:`~mitsim.talk.talk_file`) -> pieces of work (:mod:`~mitsim.talk.plan`), each made once by
this process or workers and kept (:mod:`~mitsim.talk.results`) -> figures -> claims with their figures and verdicts
(:mod:`~mitsim.talk.claims_of_sensors`, :mod:`~mitsim.talk.claims_of_coupons`, :mod:`~mitsim.talk.claims_of_views`) ->
page and Markdown (:mod:`~mitsim.talk.page`).
"""
