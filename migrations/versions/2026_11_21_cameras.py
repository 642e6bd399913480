"""Cameras and their revisions."""

import sqlalchemy as sa
from alembic import op

revision = "2026_11_21_cameras"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "cameras",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("updated_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("deleted_at", sa.DateTime(timezone=True), nullable=True),
        sa.PrimaryKeyConstraint("id", name="pk_cameras"),
        sa.UniqueConstraint("name", name="uq_cameras_name"),
    )
    op.create_table(
        "camera_revisions",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("camera_id", sa.Integer(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("description", sa.String(1000), nullable=True),
        sa.Column("source", sa.String(16), nullable=False),
        sa.Column("image_width_px", sa.Integer(), nullable=False),
        sa.Column("image_height_px", sa.Integer(), nullable=False),
        sa.Column("focus_distance_m", sa.Float(), nullable=False),
        sa.Column("k_cam_px", sa.Float(), nullable=False),
        sa.Column("gamma_px", sa.Float(), nullable=False),
        sa.Column("k_r", sa.Float(), nullable=False),
        sa.Column("focal_length_mm", sa.Float(), nullable=True),
        sa.Column("f_number", sa.Float(), nullable=True),
        sa.Column("pixel_pitch_um", sa.Float(), nullable=True),
        sa.Column("sensor_width_px", sa.Integer(), nullable=True),
        sa.Column("fx_px", sa.Float(), nullable=True),
        sa.Column("fy_px", sa.Float(), nullable=True),
        sa.Column("cx_px", sa.Float(), nullable=True),
        sa.Column("cy_px", sa.Float(), nullable=True),
        sa.Column("distortion", sa.JSON(), nullable=True),
        sa.PrimaryKeyConstraint("id", name="pk_camera_revisions"),
        sa.ForeignKeyConstraint(["camera_id"], ["cameras.id"], name="fk_camera_revisions_camera_id_cameras"),
        sa.UniqueConstraint("camera_id", "revision", name="uq_camera_revisions_camera_id_revision"),
    )


def downgrade() -> None:
    op.drop_table("camera_revisions")
    op.drop_table("cameras")
