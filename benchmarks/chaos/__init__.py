"""Breaking a run on purpose, and checking afterwards that every promise held.

* ``schedule``: which fault comes when: a function of a seed
* ``site``: the run under test, and the hosts and links around it
* ``faults``: how each kind of fault is made and lifted: one table
* ``peers``: the bad peers, each a process of its own
* ``check``: reads the histories that actors and learners wrote, and says what did not hold
"""
