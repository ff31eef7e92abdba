"""The verdict on a recording, from the recording alone. Never imports the bridge."""

from hapticbridge.audit.report import AuditReport as AuditReport
from hapticbridge.audit.verdict import audit as audit
