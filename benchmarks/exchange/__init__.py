"""Every state that two actors and a learner can reach together, within bounds, visited once.

    python -m benchmarks.exchange --json

The parts are the real ones: `services.actor.outbox` and `services.learner.intake`.

* ``model``: what is around them, and every step that can come next
* ``invariants``: what holds in every state
* ``search``: visits the states, nearest first
"""
