"""Studies with marks, and trials that an operator wants ended are remembered until they are."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Add the columns; studies of before keep the names that agents know them by."""
    mark = sa.Column("mark", sa.String(16), nullable=False, server_default="")
    op.add_column("studies", mark)
    cancelled = sa.Column("cancelled", sa.Boolean, nullable=False, server_default=sa.false())
    op.add_column("trials", cancelled)


def downgrade() -> None:
    """Drop them."""
    op.drop_column("trials", "cancelled")
    op.drop_column("studies", "mark")
