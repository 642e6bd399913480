"""How calibrations come in: room in the queue, photographs on the disk, and a row in the database, once."""

import hashlib
import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated
from uuid import uuid4

from fastapi import Depends, Request
from fastapi.concurrency import run_in_threadpool

from service.api.calibration_schemas import CalibrationSettings
from service.api.calibration_uploads import FormLimits, receive_form
from service.api.dependencies import CalibrationsDep, SettingsDep, SpoolDep
from service.config import Settings
from service.errors import Busy
from service.principal import Principal
from service.storage.calibrations import CalibrationDraft, CalibrationRecord, Calibrations
from service.storage.idempotency import once_of
from service.storage.spool import Spool

RETRY_AFTER_S = 30


@dataclass(frozen=True, slots=True)
class Intake:
    """Takes in what a principal asks for, as far as the settings leave room."""

    calibrations: Calibrations
    spool: Spool
    settings: Settings
    principal: Principal

    async def receive(self, request: Request, camera: str, idempotency_key: str | None) -> CalibrationRecord:
        """The calibration in a request's form, with its photographs on the disk and its row in the database.

        Raises ``Busy`` where there is no room, and what ``receive_form`` raises.
        """
        await self._require_room(idempotency_key)
        settings, calibration_id = self.settings, uuid4().hex
        limits = FormLimits(settings.max_calibration_images, settings.max_image_bytes, settings.max_json_bytes)
        with self.spool.receiving(calibration_id, self.principal.owner) as folder:
            form = await receive_form(request, folder, limits)
            wanted = CalibrationSettings.from_form(form.settings).model_dump(mode="json")
            draft = CalibrationDraft(calibration_id, self.spool.id, camera, wanted, form.pictures)
            return await run_in_threadpool(self._store, draft, idempotency_key)

    async def _require_room(self, idempotency_key: str | None) -> None:
        """What was done before will not wait once more, but its photographs arrive like others."""
        has_done, waits = self.calibrations.has_done, self.calibrations.waiting
        is_repeated = idempotency_key is not None and await run_in_threadpool(has_done, idempotency_key)
        waiting = Counter[str]() if is_repeated else await run_in_threadpool(waits, self.spool.id)
        held, sharer = waiting + self.spool.incoming, self.principal.sharer
        own = held[sharer] if sharer is not None else 0
        if held.total() + own >= self.settings.calibration_queue_size:
            whose = f", {own} of them this owner's" if own else ""
            detail = f"{held.total()} calibrations wait already{whose}: try again later."
            raise Busy(detail, retry_after_s=RETRY_AFTER_S)

    def _store(self, draft: CalibrationDraft, idempotency_key: str | None) -> CalibrationRecord:
        self.spool.seal(draft.id)
        record = self.calibrations.add(draft, once_of(idempotency_key, self._parts(draft)))
        if record.id != draft.id:  # the request was done before, and these are its photographs once more
            self.spool.remove(draft.id)
        return record

    def _parts(self, draft: CalibrationDraft) -> Iterator[bytes]:
        """All that makes a request for a calibration what it is."""
        yield json.dumps([draft.camera, draft.settings]).encode()
        for picture, path in zip(draft.pictures, self.spool.paths(draft.id, len(draft.pictures)), strict=True):
            yield f"{picture.role} {picture.name}".encode()
            with path.open("rb") as file:
                yield hashlib.file_digest(file, "sha256").digest()


async def get_intake(request: Request, calibrations: CalibrationsDep, spool: SpoolDep, settings: SettingsDep) -> Intake:
    return Intake(calibrations, spool, settings, request.state.principal)


IntakeDep = Annotated[Intake, Depends(get_intake)]
