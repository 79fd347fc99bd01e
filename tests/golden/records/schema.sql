CREATE INDEX captures_by_time ON captures (taken_at, id);

CREATE INDEX captures_to_sign ON captures (id) WHERE record_sha256 IS NULL;

CREATE INDEX keys_by_time ON keys (done_at);

CREATE INDEX persons_to_sign ON persons (number) WHERE record_sha256 IS NULL;

CREATE INDEX shots_by_visit ON shots (visit);

CREATE INDEX visits_by_day ON visits (day);

CREATE INDEX visits_by_time ON visits (begun_at, id);

CREATE INDEX visits_to_send ON visits (finished_at) WHERE finished_at IS NOT NULL AND (sent IS NULL OR sent <> finished_at);

CREATE INDEX visits_to_sign ON visits (id) WHERE record_sha256 IS NULL;

CREATE TABLE alembic_version (
	version_num VARCHAR(32) NOT NULL, 
	CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num)
);

CREATE TABLE captures (
	id TEXT NOT NULL, 
	eye TEXT NOT NULL, 
	taken_at TEXT NOT NULL, 
	simulated INTEGER NOT NULL, 
	calibration_id TEXT NOT NULL, 
	report TEXT NOT NULL, visit TEXT GENERATED ALWAYS AS (CASE WHEN json_valid(report) THEN CASE json_type(report, '$.visit') WHEN 'text' THEN json_extract(report, '$.visit') END END) VIRTUAL, slot TEXT GENERATED ALWAYS AS (CASE WHEN json_valid(report) THEN CASE json_type(report, '$.slot') WHEN 'text' THEN json_extract(report, '$.slot') END END) VIRTUAL, verdict TEXT GENERATED ALWAYS AS (CASE WHEN json_valid(report) THEN CASE json_type(report, '$.verdict') WHEN 'object' THEN json_extract(report, '$.verdict') END END) VIRTUAL, laterality TEXT GENERATED ALWAYS AS (CASE WHEN json_valid(report) THEN CASE json_type(report, '$.laterality') WHEN 'object' THEN json_extract(report, '$.laterality') END END) VIRTUAL, request TEXT, revision INTEGER DEFAULT '0' NOT NULL, record_sha256 TEXT, 
	PRIMARY KEY (id), 
	CONSTRAINT eye_is_an_eye CHECK (eye IN ('OD', 'OS')), 
	CONSTRAINT simulated_is_yes_or_no CHECK (simulated IN (0, 1)), 
	CONSTRAINT report_is_json CHECK (json_valid(report))
)
 STRICT;

CREATE TABLE counters (
	prefix TEXT NOT NULL, 
	last INTEGER NOT NULL, 
	PRIMARY KEY (prefix), 
	CONSTRAINT counters_count CHECK (last >= 0)
)
 STRICT;

CREATE TABLE fields (
	visit TEXT NOT NULL, 
	name TEXT NOT NULL, 
	value TEXT NOT NULL, 
	set_at TEXT NOT NULL, 
	PRIMARY KEY (visit, name), 
	CONSTRAINT field_is_json CHECK (json_valid(value)), 
	CONSTRAINT field_is_short CHECK (length(value) <= 2000), 
	FOREIGN KEY(visit) REFERENCES visits (id)
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

CREATE TABLE identifiers (
	person TEXT NOT NULL, 
	name TEXT NOT NULL, 
	value TEXT NOT NULL, 
	PRIMARY KEY (person, name), 
	CONSTRAINT identifier_is_json CHECK (json_valid(value)), 
	CONSTRAINT identifier_is_short CHECK (length(value) <= 2000), 
	FOREIGN KEY(person) REFERENCES persons (number)
)
 STRICT;

CREATE TABLE keys (
	"key" TEXT NOT NULL, 
	request TEXT NOT NULL, 
	answer TEXT NOT NULL, 
	done_at TEXT NOT NULL, 
	PRIMARY KEY ("key"), 
	CONSTRAINT key_is_whole CHECK (length(key) = 16)
)
 STRICT;

CREATE TABLE light_doses (
	eye TEXT NOT NULL, 
	slot INTEGER NOT NULL, 
	dose_j_per_cm2 REAL NOT NULL, 
	PRIMARY KEY (eye, slot), 
	CONSTRAINT light_fell_on_an_eye CHECK (eye IN ('OD', 'OS')), 
	CONSTRAINT light_is_not_given_back CHECK (dose_j_per_cm2 >= 0)
)
 STRICT;

CREATE TABLE light_time (
	id INTEGER NOT NULL, 
	boot TEXT NOT NULL, 
	now_s REAL NOT NULL, 
	observed_s REAL NOT NULL, 
	PRIMARY KEY (id), 
	CONSTRAINT time_is_one CHECK (id = 1)
)
 STRICT;

CREATE TABLE persons (
	number TEXT NOT NULL, 
	made_at TEXT NOT NULL, patient_id TEXT, revision INTEGER DEFAULT '0' NOT NULL, record_sha256 TEXT, 
	PRIMARY KEY (number), 
	CONSTRAINT number_is_short CHECK (length(number) BETWEEN 1 AND 20)
)
 STRICT;

CREATE TABLE sendings (
	visit TEXT NOT NULL, 
	finished_at TEXT NOT NULL, 
	tries INTEGER NOT NULL, 
	failing_since TEXT, 
	error TEXT, 
	said TEXT, 
	sent_at TEXT, 
	sha256 TEXT, 
	confirmed TEXT, 
	PRIMARY KEY (visit, finished_at), 
	CONSTRAINT tries_are_counted CHECK (tries >= 0), 
	CONSTRAINT what_was_sent_is_known CHECK ((sent_at IS NULL) = (sha256 IS NULL)), 
	CONSTRAINT what_was_sent_was_confirmed CHECK ((sent_at IS NULL) = (confirmed IS NULL)), 
	FOREIGN KEY(visit) REFERENCES visits (id)
)
 STRICT;

CREATE TABLE shots (
	capture TEXT NOT NULL, 
	visit TEXT NOT NULL, 
	slot TEXT NOT NULL, 
	PRIMARY KEY (capture), 
	FOREIGN KEY(capture) REFERENCES captures (id), 
	FOREIGN KEY(visit) REFERENCES visits (id)
)
 STRICT;

CREATE TABLE slots (
	visit TEXT NOT NULL, 
	slot TEXT NOT NULL, 
	capture TEXT, 
	reason TEXT, 
	PRIMARY KEY (visit, slot), 
	CONSTRAINT taken_or_could_not CHECK (capture IS NULL OR reason IS NULL), 
	FOREIGN KEY(visit) REFERENCES visits (id), 
	FOREIGN KEY(capture) REFERENCES captures (id)
)
 STRICT;

CREATE TABLE visits (
	id TEXT NOT NULL, 
	person TEXT NOT NULL, 
	day TEXT NOT NULL, 
	begun_at TEXT NOT NULL, 
	finished_at TEXT, 
	outcome TEXT, sent TEXT, request TEXT, revision INTEGER DEFAULT '0' NOT NULL, record_sha256 TEXT, 
	PRIMARY KEY (id), 
	CONSTRAINT what_is_finished_has_an_outcome CHECK ((finished_at IS NULL) = (outcome IS NULL)), 
	CONSTRAINT outcome_is_json CHECK (outcome IS NULL OR json_valid(outcome)), 
	FOREIGN KEY(person) REFERENCES persons (number)
)
 STRICT;

CREATE TRIGGER captures_changed AFTER UPDATE OF eye, taken_at, simulated, calibration_id, report, request ON captures BEGIN UPDATE captures SET record_sha256 = NULL WHERE id = NEW.id; END;

CREATE TRIGGER captures_of_visit_changed AFTER UPDATE OF eye, report ON captures BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER fields_delete AFTER DELETE ON fields BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = OLD.visit; END;

CREATE TRIGGER fields_insert AFTER INSERT ON fields BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER fields_update AFTER UPDATE ON fields BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER files_delete AFTER DELETE ON files BEGIN UPDATE captures SET record_sha256 = NULL WHERE id = OLD.capture_id; END;

CREATE TRIGGER files_insert AFTER INSERT ON files BEGIN UPDATE captures SET record_sha256 = NULL WHERE id = NEW.capture_id; END;

CREATE TRIGGER files_update AFTER UPDATE ON files BEGIN UPDATE captures SET record_sha256 = NULL WHERE id = NEW.capture_id; END;

CREATE TRIGGER identifiers_delete AFTER DELETE ON identifiers BEGIN UPDATE persons SET record_sha256 = NULL WHERE number = OLD.person; END;

CREATE TRIGGER identifiers_insert AFTER INSERT ON identifiers BEGIN UPDATE persons SET record_sha256 = NULL WHERE number = NEW.person; END;

CREATE TRIGGER identifiers_update AFTER UPDATE ON identifiers BEGIN UPDATE persons SET record_sha256 = NULL WHERE number = NEW.person; END;

CREATE TRIGGER persons_changed AFTER UPDATE OF number, made_at, patient_id ON persons BEGIN UPDATE persons SET record_sha256 = NULL WHERE number = NEW.number; END;

CREATE TRIGGER sendings_delete AFTER DELETE ON sendings WHEN OLD.sent_at IS NOT NULL BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = OLD.visit; END;

CREATE TRIGGER sendings_insert AFTER INSERT ON sendings WHEN NEW.sent_at IS NOT NULL BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER sendings_update AFTER UPDATE ON sendings WHEN NEW.sent_at IS NOT NULL BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER slots_delete AFTER DELETE ON slots BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = OLD.visit; END;

CREATE TRIGGER slots_insert AFTER INSERT ON slots BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER slots_update AFTER UPDATE ON slots BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.visit; END;

CREATE TRIGGER visits_changed AFTER UPDATE OF person, day, begun_at, finished_at, outcome, sent, request ON visits BEGIN UPDATE visits SET record_sha256 = NULL WHERE id = NEW.id; END;

