"""Who may say what: one table of roles, and the access rules that the hub makes from it.

With TLS a service is who its certificate says, `<role>-<id>`. The hub takes from it, and gives to it, only what the
table allows to its role, on keys that name its id. Everything else is dropped without a word. A certificate that is
not in the hub's folder may do nothing.

The rules belong to the node that listens. Here that is the hub: the learner's session. A router of a site needs them
in its own configuration. Between services that were connected with each other directly, no node would apply them.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, Final

from common.comms.keys import KeyPartError, Keys

OPERATOR: Final = "operator"  # who starts and watches a run


@dataclass(frozen=True, slots=True)
class Rights:
    """The key expressions on which one service may act."""

    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    ask: tuple[str, ...] = ()  # send requests
    answer: tuple[str, ...] = ()  # serve them
    show: tuple[str, ...] = ()  # its own liveliness tokens
    watch: tuple[str, ...] = ()  # those of others


def _rank(learner: str) -> int:
    """Return the rank of a learner; of one that is not in any group it is 0."""
    return int(learner) if learner.isdecimal() else 0


def _led(keys: Keys, learner: str) -> tuple[str, ...]:
    """Return the keys of what only the leading learner says."""
    return () if _rank(learner) else (keys.policy(), keys.stage(), keys.join())


ROLES: Final[Mapping[str, Callable[[Keys, str], Rights]]] = MappingProxyType(
    {
        "learner": lambda keys, id_: Rights(
            publish=(*_led(keys, id_), keys.status("learner", id_)),
            answer=(
                *(*_led(keys, id_), keys.every_rollout(_rank(id_)), keys.every_report(_rank(id_))),
                keys.ctl("learner", id_),
            ),
            show=(keys.every_life_of("learner", id_),),
            watch=(keys.every_alive(),),
        ),
        "actor": lambda keys, id_: Rights(
            publish=(keys.status("actor", id_),),
            subscribe=(keys.policy(), keys.stage(), keys.every_rally()),
            ask=(
                keys.rollouts_to_any(id_),
                keys.reports_to_any(id_),
                keys.policy(),
                keys.join(),
                keys.every_rally(),
            ),
            answer=(keys.ctl("actor", id_),),
            show=(keys.every_life_of("actor", id_),),
            watch=(keys.every_life_of("learner", "0"),),
        ),
        "generator": lambda keys, id_: Rights(
            publish=(keys.every_rally(), keys.status("generator", id_)),
            answer=(keys.every_rally(), keys.ctl("generator", id_)),
            show=(keys.every_life_of("generator", id_),),
        ),
        "evaluator": lambda keys, id_: Rights(
            publish=(keys.status("evaluator", id_),),
            ask=(keys.policy(),),
            answer=(keys.ctl("evaluator", id_),),
            show=(keys.every_life_of("evaluator", id_),),
        ),
        OPERATOR: lambda keys, _id: Rights(
            subscribe=(keys.every_status(),),
            ask=(keys.every_ctl(), keys.stage()),
            watch=(keys.every_alive(),),
        ),
    }
)

# What Zenoh calls the parts of each right: messages from the service to the hub, and from the hub to it.
_MESSAGES: Final[Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]]] = MappingProxyType(
    {
        "publish": (("put",), ()),
        "subscribe": (("declare_subscriber",), ("put",)),
        "ask": (("query",), ("reply",)),
        "answer": (("declare_queryable", "reply"), ("query",)),
        "show": (("liveliness_token",), ()),
        "watch": (("declare_liveliness_subscriber", "liveliness_query"), ("liveliness_token",)),
    }
)
# Which keys others subscribe to and serve. Without it a publisher does not know that it has subscribers. It tells no
# content, and its expressions are wider than a right: the learner serves the rollouts of all actors.
_TOLD: Final = ("declare_subscriber", "declare_queryable")


def name_of(role: str, id_: str) -> str:
    """Return the common name of a service's certificate."""
    return f"{role}-{id_}"


OPERATOR_NAME: Final = name_of(OPERATOR, "0")


def rights_of(name: str, keys: Keys) -> Rights:
    """Return what the owner of a certificate may do in a run.

    Raises:
        KeyPartError: The name is not ``<role>-<id>``.
    """
    role, _, id_ = name.partition("-")
    if role not in ROLES:
        raise KeyPartError(
            f"unknown role in the certificate's name {name!r}; allowed: <role>-<id> with {', '.join(ROLES)}"
        )
    keys.ctl("actor", id_)  # refuses an id that can't stand in a key
    return ROLES[role](keys, id_)


def access_control(names: Iterable[str], run: str) -> dict[str, Any]:
    """Return Zenoh's setting ``access_control`` for the hub of a run that admits the owners of these certificates."""
    keys = Keys(run)
    told = {
        "id": "told",
        "permission": "allow",
        "messages": list(_TOLD),
        "flows": ["egress"],
        "key_exprs": [keys.everything()],
    }
    rules, subjects, policies = [told], [], []
    for name in names:
        rights = rights_of(name, keys)
        own = ["told"]
        for right in fields(rights):
            key_exprs = list(getattr(rights, right.name))
            for flow, messages in zip(("ingress", "egress"), _MESSAGES[right.name], strict=True):
                if key_exprs and messages:
                    own.append(f"{name} {right.name} {flow}")
                    rules.append(
                        {
                            "id": own[-1],
                            "permission": "allow",
                            "messages": list(messages),
                            "flows": [flow],
                            "key_exprs": key_exprs,
                        }
                    )
        subjects.append({"id": name, "cert_common_names": [name]})
        policies.append({"id": name, "rules": own, "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }
