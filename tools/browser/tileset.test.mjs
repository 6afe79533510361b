// The written files, judged by the official glTF validator and the official 3D Tiles JSON schemas.
//   TILESET=folder SCHEMAS=…/schemas/3d-tiles-1.1 node --test tileset.test.mjs
import assert from 'node:assert/strict';
import { readFileSync, readdirSync } from 'node:fs';
import { join, posix } from 'node:path';
import { describe, test } from 'node:test';
import Ajv2020 from 'ajv/dist/2020.js';
import validator from 'gltf-validator';
import { TILESET, missing } from './browser.mjs';

// What version 2.0.0-dev.3.10 does not know: extensions newer than itself, and what only they refer to.
const UNKNOWN_TO_IT = ['UNSUPPORTED_EXTENSION', 'UNUSED_OBJECT'];

const files = (folder, ending) => readdirSync(folder, { recursive: true }).map(String).filter((path) => path.endsWith(ending)).sort();

describe('glTF', { skip: missing('tileset') }, () => {
  test('every GLB passes the glTF validator without an error', async () => {
    const glbs = files(TILESET, '.glb'), faults = [];
    assert.ok(glbs.length > 0, 'no .glb in the tileset');
    for (const path of glbs) {
      // It throws on what does not look like glTF at all.
      const report = await validator.validateBytes(new Uint8Array(readFileSync(join(TILESET, path))), { uri: path, maxIssues: 50, ignoredIssues: UNKNOWN_TO_IT })
        .catch((error) => ({ issues: { numErrors: 1, messages: [{ severity: 0, code: String(error) }] } }));
      if (report.issues.numErrors > 0) faults.push(...report.issues.messages.filter((m) => m.severity === 0).map((m) => `${path}: ${m.code} ${m.message ?? ''} ${m.pointer ?? ''}`));
    }
    assert.deepEqual(faults.slice(0, 20), [], `${faults.length} errors in ${glbs.length} files`);
  });
});

/** A validator of the schema `name`; the schemas refer to each other by file, from sub-folders also by bare name. */
function compile(folder, name) {
  const ajv = new Ajv2020({ strict: false, allErrors: true, validateFormats: false });
  const paths = files(folder, '.schema.json').map((path) => path.replaceAll('\\', '/'));
  const mend = (node, from) => {
    for (const [key, value] of Object.entries(node)) {
      if (key === '$ref' && typeof value === 'string' && !value.startsWith('#')) {
        const beside = posix.normalize(posix.join(posix.dirname(from), value));
        const found = paths.includes(beside) ? beside : paths.find((path) => posix.basename(path) === posix.basename(value));
        // Extensions may refer to schemas of glTF, which are not here: then anything goes.
        if (found) node[key] = `rooftile:/${found}`; else delete node[key];
      } else if (value && typeof value === 'object') mend(value, from);
    }
  };
  for (const path of paths) {
    const schema = JSON.parse(readFileSync(join(folder, path), 'utf8'));
    mend(schema, path);
    schema.$id = `rooftile:/${path}`;
    ajv.addSchema(schema);
  }
  return ajv.getSchema(`rooftile:/${name}`);
}

describe('3D Tiles', { skip: missing('tileset', 'schemas') }, () => {
  const valid = process.env.SCHEMAS ? compile(process.env.SCHEMAS, 'tileset.schema.json') : null;
  const tileset = () => JSON.parse(readFileSync(join(TILESET, 'tileset.json'), 'utf8'));

  test('tileset.json keeps to the official schema', () => {
    assert.ok(valid(tileset()), JSON.stringify(valid.errors?.slice(0, 10), null, 1));
  });

  test('the schema finds a planted fault', () => {
    for (const plant of [(t) => delete t.root.geometricError, (t) => { t.root.boundingVolume.box = [1]; }, (t) => { t.asset.version = 1; }, (t) => { (t.root.children ??= []).push({ boundingVolume: {} }); }]) {
      const broken = tileset();
      broken.root.boundingVolume = { box: [0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1] };
      plant(broken);
      assert.equal(valid(broken), false, String(plant));
    }
  });
});

describe('the tree', { skip: missing('tileset') }, () => {
  test('errors never grow downward and every content is there', () => {
    const there = new Set(readdirSync(TILESET, { recursive: true }).map((path) => String(path).replaceAll('\\', '/')));
    const json = JSON.parse(readFileSync(join(TILESET, 'tileset.json'), 'utf8')), faults = [];
    const walk = (tile, limit, at) => {
      if (!(tile.geometricError >= 0 && tile.geometricError <= limit)) faults.push(`${at}: geometricError ${tile.geometricError} above its parent's ${limit}`);
      for (const { uri } of [tile.content, ...(tile.contents ?? [])].filter(Boolean)) {
        if (!uri.includes('{') && !there.has(posix.normalize(decodeURIComponent(uri)))) faults.push(`${at}: no file ${uri}`);
      }
      tile.children?.forEach((child, i) => walk(child, tile.geometricError, `${at}/${i}`));
    };
    walk(json.root, json.geometricError, 'root');
    assert.deepEqual(faults.slice(0, 20), []);
  });
});
