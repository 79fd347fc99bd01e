CREATE INDEX capture_slots_by_visit ON capture_slots (visit);

CREATE INDEX captures_by_time ON captures (taken_at, id);

CREATE INDEX captures_to_sign ON captures (id) WHERE record_sha256 IS NULL;

CREATE INDEX idempotency_keys_by_time ON idempotency_keys (done_at);

CREATE INDEX patients_to_sign ON patients (patient_id) WHERE record_sha256 IS NULL;

CREATE INDEX visits_by_day ON visits (day);

CREATE INDEX visits_by_time ON visits (begun_at, id);

CREATE INDEX visits_to_sign ON visits (id) WHERE record_sha256 IS NULL;

CREATE INDEX visits_to_upload ON visits (finished_at) WHERE finished_at IS NOT NULL AND (sent IS NULL OR sent <> finished_at);

CREATE TABLE alembic_version (
	version_num VARCHAR(32) NOT NULL, 
	CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num)
);

CREATE TABLE answers (
	visit TEXT NOT NULL, 
	name TEXT NOT NULL, 
	value TEXT NOT NULL, 
	set_at TEXT NOT NULL, 
	PRIMARY KEY (visit, name), 
	CONSTRAINT answer_is_json CHECK (json_valid(value)), 
	CONSTRAINT answer_is_short CHECK (length(value) <= 2000), 
	FOREIGN KEY(visit) REFERENCES visits (id)
)
 STRICT;

CREATE TABLE capture_slots (
	capture TEXT NOT NULL, 
	visit TEXT NOT NULL, 
	slot TEXT NOT NULL, 
	PRIMARY KEY (capture), 
	FOREIGN KEY(capture) REFERENCES captures (id), 
	FOREIGN KEY(visit) REFERENCES visits (id)
)
 STRICT;

CREATE TABLE captures (
	id TEXT NOT NULL, 
	eye TEXT NOT NULL, 
	taken_at TEXT NOT NULL, 
	simulated INTEGER NOT NULL, 
	calibration_id TEXT NOT NULL, 
	report TEXT NOT NULL, 
	visit TEXT GENERATED ALWAYS AS (CASE WHEN json_valid(report) THEN CASE json_type(report, '$.visit') WHEN 'text' THEN json_extract(report, '$.visit') END END) VIRTUAL, 
	slot TEXT GENERATED ALWAYS AS (CASE WHEN json_valid(report) THEN CASE json_type(report, '$.slot') WHEN 'text' THEN json_extract(report, '$.slot') END END) VIRTUAL, 
	verdict TEXT GENERATED ALWAYS AS (CASE WHEN json_valid(report) THEN CASE json_type(report, '$.verdict') WHEN 'object' THEN json_extract(report, '$.verdict') END END) VIRTUAL, 
	laterality TEXT GENERATED ALWAYS AS (CASE WHEN json_valid(report) THEN CASE json_type(report, '$.laterality') WHEN 'object' THEN json_extract(report, '$.laterality') END END) VIRTUAL, 
	request TEXT, 
	revision INTEGER DEFAULT '0' NOT NULL, 
	record_sha256 TEXT, 
	PRIMARY KEY (id), 
	CONSTRAINT eye_is_an_eye CHECK (eye IN ('OD', 'OS')), 
	CONSTRAINT simulated_is_yes_or_no CHECK (simulated IN (0, 1)), 
	CONSTRAINT report_is_json CHECK (json_valid(report))
)
 STRICT;

CREATE TABLE changes (
	visit TEXT NOT NULL, 
	number INTEGER NOT NULL, 
	at TEXT NOT NULL, 
	user TEXT NOT NULL, 
	field TEXT NOT NULL, 
	was TEXT NOT NULL, 
	value TEXT NOT NULL, 
	why TEXT, 
	PRIMARY KEY (visit, number), 
	CONSTRAINT change_is_json CHECK (json_valid(was) AND json_valid(value)), 
	FOREIGN KEY(visit) REFERENCES visits (id)
)
 STRICT;

CREATE TABLE counters (
	prefix TEXT NOT NULL, 
	last INTEGER NOT NULL, 
	PRIMARY KEY (prefix), 
	CONSTRAINT counter_is_not_negative CHECK (last >= 0)
)
 STRICT;

CREATE TABLE doses (
	eye TEXT NOT NULL, 
	interval INTEGER NOT NULL, 
	dose_j_per_cm2 REAL NOT NULL, 
	PRIMARY KEY (eye, interval), 
	CONSTRAINT dose_is_of_an_eye CHECK (eye IN ('OD', 'OS')), 
	CONSTRAINT dose_is_not_negative CHECK (dose_j_per_cm2 >= 0)
)
 STRICT;

CREATE TABLE files (
	capture_id TEXT NOT NULL, 
	name TEXT NOT NULL, 
	sha256 TEXT NOT NULL, 
	bytes INTEGER NOT NULL, 
	PRIMARY KEY (capture_id, name), 
	CONSTRAINT sha256_is_whole CHECK (length(sha256) = 64), 
	CONSTRAINT bytes_is_a_length CHECK (bytes >= 0), 
	FOREIGN KEY(capture_id) REFERENCES captures (id)
)
 STRICT;

CREATE TABLE idempotency_keys (
	"key" TEXT NOT NULL, 
	request TEXT NOT NULL, 
	answer TEXT NOT NULL, 
	done_at TEXT NOT NULL, 
	PRIMARY KEY ("key"), 
	CONSTRAINT key_is_whole CHECK (length(key) = 16)
)
 STRICT;

CREATE TABLE observed_time (
	id INTEGER NOT NULL, 
	boot TEXT NOT NULL, 
	now_s REAL NOT NULL, 
	observed_s REAL NOT NULL, 
	PRIMARY KEY (id), 
	CONSTRAINT time_is_one_row CHECK (id = 1)
)
 STRICT;

CREATE TABLE patients (
	patient_id TEXT NOT NULL, 
	made_at TEXT NOT NULL, 
	identity TEXT NOT NULL, 
	revision INTEGER DEFAULT '0' NOT NULL, 
	record_sha256 TEXT, 
	PRIMARY KEY (patient_id)
)
 STRICT;

CREATE TABLE slot_decisions (
	visit TEXT NOT NULL, 
	slot TEXT NOT NULL, 
	capture TEXT, 
	reason TEXT, 
	PRIMARY KEY (visit, slot), 
	CONSTRAINT capture_or_reason CHECK (capture IS NULL OR reason IS NULL), 
	FOREIGN KEY(visit) REFERENCES visits (id), 
	FOREIGN KEY(capture) REFERENCES captures (id)
)
 STRICT;

CREATE TABLE uploads (
	visit TEXT NOT NULL, 
	finished_at TEXT NOT NULL, 
	tries INTEGER NOT NULL, 
	failing_since TEXT, 
	error TEXT, 
	message TEXT, 
	sent_at TEXT, 
	sha256 TEXT, 
	confirmed TEXT, 
	PRIMARY KEY (visit, finished_at), 
	CONSTRAINT tries_are_not_negative CHECK (tries >= 0), 
	CONSTRAINT sent_has_a_digest CHECK ((sent_at IS NULL) = (sha256 IS NULL)), 
	CONSTRAINT sent_has_a_confirmation CHECK ((sent_at IS NULL) = (confirmed IS NULL)), 
	FOREIGN KEY(visit) REFERENCES visits (id)
)
 STRICT;

CREATE TABLE visits (
	id TEXT NOT NULL, 
	patient TEXT NOT NULL, 
	day TEXT NOT NULL, 
	begun_at TEXT NOT NULL, 
	finished_at TEXT, 
	outcome TEXT, 
	sent TEXT, 
	request TEXT, 
	revision INTEGER DEFAULT '0' NOT NULL, 
	record_sha256 TEXT, 
	PRIMARY KEY (id), 
	CONSTRAINT finished_has_an_outcome CHECK ((finished_at IS NULL) = (outcome IS NULL)), 
	CONSTRAINT outcome_is_json CHECK (outcome IS NULL OR json_valid(outcome)), 
	FOREIGN KEY(patient) REFERENCES patients (patient_id)
)
 STRICT;

CREATE TRIGGER answers_delete AFTER DELETE ON answers BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = OLD.visit; END;

CREATE TRIGGER answers_insert AFTER INSERT ON answers BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER answers_update AFTER UPDATE ON answers BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER captures_changed AFTER UPDATE OF eye, taken_at, simulated, calibration_id, report, request ON captures BEGIN UPDATE captures SET record_sha256 = NULL WHERE id = NEW.id; END;

CREATE TRIGGER captures_of_visit_changed AFTER UPDATE OF eye, report ON captures BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER changes_delete AFTER DELETE ON changes BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = OLD.visit; END;

CREATE TRIGGER changes_insert AFTER INSERT ON changes BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER changes_update AFTER UPDATE ON changes BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER files_delete AFTER DELETE ON files BEGIN UPDATE captures SET record_sha256 = NULL WHERE id = OLD.capture_id; END;

CREATE TRIGGER files_insert AFTER INSERT ON files BEGIN UPDATE captures SET record_sha256 = NULL WHERE id = NEW.capture_id; END;

CREATE TRIGGER files_update AFTER UPDATE ON files BEGIN UPDATE captures SET record_sha256 = NULL WHERE id = NEW.capture_id; END;

CREATE TRIGGER patients_changed AFTER UPDATE OF patient_id, made_at, identity ON patients BEGIN UPDATE patients SET record_sha256 = NULL WHERE patient_id = NEW.patient_id; END;

CREATE TRIGGER slot_decisions_delete AFTER DELETE ON slot_decisions BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = OLD.visit; END;

CREATE TRIGGER slot_decisions_insert AFTER INSERT ON slot_decisions BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER slot_decisions_update AFTER UPDATE ON slot_decisions BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER uploads_delete AFTER DELETE ON uploads WHEN OLD.sent_at IS NOT NULL BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = OLD.visit; END;

CREATE TRIGGER uploads_insert AFTER INSERT ON uploads WHEN NEW.sent_at IS NOT NULL BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER uploads_update AFTER UPDATE ON uploads WHEN NEW.sent_at IS NOT NULL BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER visits_changed AFTER UPDATE OF patient, day, begun_at, finished_at, outcome, sent, request ON visits BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.id; END;

