-- A database as the release before there were migrations made it.
BEGIN TRANSACTION;
CREATE TABLE alarms (
	seq INTEGER NOT NULL, 
	model VARCHAR(64) NOT NULL, 
	kind VARCHAR NOT NULL, 
	at VARCHAR NOT NULL, 
	message VARCHAR NOT NULL, 
	evidence JSON NOT NULL, 
	PRIMARY KEY (seq), 
	FOREIGN KEY(model) REFERENCES models (name)
);
CREATE TABLE datasets (
	seq INTEGER NOT NULL, 
	id VARCHAR(40) NOT NULL, 
	name VARCHAR NOT NULL, 
	created_at VARCHAR NOT NULL, 
	sha256 VARCHAR NOT NULL, 
	torque_convention VARCHAR NOT NULL, 
	joint_names JSON NOT NULL, 
	rows INTEGER NOT NULL, 
	report JSON NOT NULL, 
	PRIMARY KEY (seq), 
	UNIQUE (id)
);
CREATE TABLE events (
	seq INTEGER NOT NULL, 
	model VARCHAR(64) NOT NULL, 
	number INTEGER NOT NULL, 
	kind VARCHAR NOT NULL, 
	stream_id VARCHAR(64), 
	sequence BIGINT, 
	last_sequence BIGINT, 
	digest VARCHAR, 
	received DOUBLE NOT NULL, 
	version INTEGER, 
	revision INTEGER, 
	rows INTEGER NOT NULL, 
	learnt INTEGER NOT NULL, 
	first DOUBLE, 
	last DOUBLE, 
	void BOOLEAN NOT NULL, 
	report JSON, 
	record JSON, 
	detail JSON, 
	payload BLOB, 
	PRIMARY KEY (seq), 
	UNIQUE (model, number), 
	UNIQUE (model, stream_id, sequence), 
	FOREIGN KEY(model) REFERENCES models (name)
);
CREATE TABLE jobs (
	seq INTEGER NOT NULL, 
	id VARCHAR(40) NOT NULL, 
	model VARCHAR NOT NULL, 
	state VARCHAR NOT NULL, 
	request JSON NOT NULL, 
	progress JSON NOT NULL, 
	attempts INTEGER NOT NULL, 
	cancel_requested BOOLEAN NOT NULL, 
	created_at VARCHAR NOT NULL, 
	started_at VARCHAR, 
	finished_at VARCHAR, 
	heartbeat_at VARCHAR, 
	version INTEGER, 
	error JSON, 
	PRIMARY KEY (seq), 
	UNIQUE (id)
);
INSERT INTO "jobs" VALUES(1,'job_1','arm','queued','{"estimator": "lip-chain", "datasets": ["ds_1"]}','{"stage": "waiting"}',0,0,'2026-11-20T00:00:00.000+00:00',NULL,NULL,NULL,NULL,NULL);
CREATE TABLE learners (
	model VARCHAR(64) NOT NULL, 
	version INTEGER NOT NULL, 
	start INTEGER NOT NULL, 
	role VARCHAR NOT NULL, 
	PRIMARY KEY (model, version), 
	FOREIGN KEY(model) REFERENCES models (name)
);
CREATE TABLE learning (
	model VARCHAR(64) NOT NULL, 
	options JSON NOT NULL, 
	held JSON, 
	PRIMARY KEY (model), 
	FOREIGN KEY(model) REFERENCES models (name)
);
CREATE TABLE models (
	seq INTEGER NOT NULL, 
	name VARCHAR(64) NOT NULL, 
	created_at VARCHAR NOT NULL, 
	PRIMARY KEY (seq), 
	UNIQUE (name)
);
INSERT INTO "models" VALUES(1,'arm','2026-11-20T00:00:00.000+00:00');
CREATE TABLE robots (
	seq INTEGER NOT NULL, 
	id VARCHAR(40) NOT NULL, 
	name VARCHAR NOT NULL, 
	created_at VARCHAR NOT NULL, 
	sha256 VARCHAR NOT NULL, 
	joints JSON NOT NULL, 
	urdf VARCHAR NOT NULL, 
	PRIMARY KEY (seq), 
	UNIQUE (id)
);
CREATE TABLE serving (
	model VARCHAR(64) NOT NULL, 
	version INTEGER NOT NULL, 
	change INTEGER NOT NULL, 
	PRIMARY KEY (model), 
	FOREIGN KEY(model) REFERENCES models (name)
);
CREATE TABLE snapshots (
	seq INTEGER NOT NULL, 
	id VARCHAR(40) NOT NULL, 
	model VARCHAR NOT NULL, 
	version INTEGER NOT NULL, 
	number INTEGER NOT NULL, 
	created_at VARCHAR NOT NULL, 
	PRIMARY KEY (seq), 
	UNIQUE (id)
);
INSERT INTO "snapshots" VALUES(1,'sn_1','arm',3,7,'2026-11-20T00:00:00.000+00:00');
CREATE TABLE streams (
	model VARCHAR(64) NOT NULL, 
	stream_id VARCHAR(64) NOT NULL, 
	kind VARCHAR NOT NULL, 
	"offset" DOUBLE NOT NULL, 
	last BIGINT NOT NULL, 
	missing JSON NOT NULL, 
	forgotten BIGINT, 
	created_at VARCHAR NOT NULL, 
	PRIMARY KEY (model, stream_id), 
	FOREIGN KEY(model) REFERENCES models (name)
);
CREATE TABLE versions (
	model VARCHAR(64) NOT NULL, 
	version INTEGER NOT NULL, 
	folder VARCHAR(40) NOT NULL, 
	created_at VARCHAR NOT NULL, 
	job VARCHAR, 
	manifest JSON NOT NULL, 
	PRIMARY KEY (model, version), 
	FOREIGN KEY(model) REFERENCES models (name), 
	UNIQUE (folder)
);
INSERT INTO "versions" VALUES('arm',1,'mv_1','2026-11-20T00:00:00.000+00:00',NULL,'{"estimator": "lip-chain"}');
INSERT INTO "versions" VALUES('arm',2,'mv_2','2026-11-20T00:00:00.000+00:00',NULL,'{"estimator": "lip-chain"}');
INSERT INTO "versions" VALUES('arm',3,'mv_3','2026-11-20T00:00:00.000+00:00',NULL,'{"estimator": "lip-chain"}');
CREATE INDEX ix_jobs_state ON jobs (state);
CREATE INDEX events_received ON events (model, received);
COMMIT;
