"""An owner's calibrations are found without a look at those of others."""

from alembic import op

revision = "2026_11_28_calibration_owners"
down_revision = "2026_11_23_keys"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_index("ix_calibrations_owner_number", "calibrations", ["owner", "number"])


def downgrade() -> None:
    op.drop_index("ix_calibrations_owner_number", "calibrations")
