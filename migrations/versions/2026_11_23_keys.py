"""API keys, what belongs to whom, and requests that may be repeated."""

import sqlalchemy as sa
from alembic import op

revision = "2026_11_23_keys"
down_revision = "2026_11_22_calibrations"
branch_labels = None
depends_on = None

LOCAL = "local"


def upgrade() -> None:
    op.create_table(
        "api_keys",
        sa.Column("id", sa.String(16), nullable=False),
        sa.Column("digest", sa.String(64), nullable=False),
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("owner", sa.String(64), nullable=False),
        sa.Column("scopes", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("expires_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("last_used_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("revoked_at", sa.DateTime(timezone=True), nullable=True),
        sa.PrimaryKeyConstraint("id", name="pk_api_keys"),
    )
    op.create_table(
        "idempotency_keys",
        sa.Column("owner", sa.String(64), nullable=False),
        sa.Column("key", sa.String(255), nullable=False),
        sa.Column("fingerprint", sa.String(64), nullable=False),
        sa.Column("outcome", sa.String(80), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("owner", "key", name="pk_idempotency_keys"),
    )
    op.create_index("ix_idempotency_keys_created_at", "idempotency_keys", ["created_at"])
    for name in ("cameras", "calibrations"):
        with op.batch_alter_table(name) as table:
            table.add_column(sa.Column("owner", sa.String(64), nullable=False, server_default=LOCAL))
    # what was there before belongs to whoever used the service without a key; nothing does so by default from here on
    with op.batch_alter_table("cameras") as table:
        table.alter_column("owner", server_default=None)
        table.drop_constraint("uq_cameras_name", type_="unique")
        table.create_unique_constraint("uq_cameras_owner_name", ["owner", "name"])
    with op.batch_alter_table("calibrations") as table:
        table.alter_column("owner", server_default=None)


def downgrade() -> None:
    # names were unique before, and there were no owners to tell them apart by
    cameras = sa.table("cameras", sa.column("id"), sa.column("owner"))
    revisions = sa.table("camera_revisions", sa.column("camera_id"))
    calibrations = sa.table("calibrations", sa.column("owner"))
    others = sa.select(cameras.c.id).where(cameras.c.owner != LOCAL)
    op.execute(sa.delete(revisions).where(revisions.c.camera_id.in_(others)))
    for table in (cameras, calibrations):
        op.execute(sa.delete(table).where(table.c.owner != LOCAL))
    with op.batch_alter_table("cameras") as batch:
        batch.drop_constraint("uq_cameras_owner_name", type_="unique")
        batch.create_unique_constraint("uq_cameras_name", ["name"])
        batch.drop_column("owner")
    with op.batch_alter_table("calibrations") as batch:
        batch.drop_column("owner")
    op.drop_table("idempotency_keys")
    op.drop_table("api_keys")
