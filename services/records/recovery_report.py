"""Report of a recovery, for health checks; needs no database, so that the command line starts without one."""

from dataclasses import dataclass, field


@dataclass
class RecoveryReport:
    """What an opening restored: ids of captures and visits, and numbers of patients.

    `adopted`: captures without rows; `healed`: captures with damaged or older rows; `visits` and `patients`: restored
    ones; `conflicts`: ids of records of which another state is stored in `conflicts/`; `missing`: chosen captures whose
    folder is gone; `lost_visits`: visits that adopted captures name, of which neither row nor file is left.
    `rebuilt_because`: why the whole database was rebuilt, else None.
    """

    adopted: list[str] = field(default_factory=list)
    healed: list[str] = field(default_factory=list)
    visits: list[str] = field(default_factory=list)
    patients: list[str] = field(default_factory=list)
    conflicts: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    lost_visits: list[str] = field(default_factory=list)
    rebuilt_because: str | None = None
