//! One test a rule, on a router over a small folder.

use super::*;
use tower::ServiceExt;

const TILE: &[u8] = b"0123456789";

struct House {
    folder: tempfile::TempDir,
    router: Router,
}

fn house() -> House {
    let outer = tempfile::tempdir().unwrap();
    std::fs::write(outer.path().join("secret.txt"), b"secret").unwrap();
    let folder = outer.path().join("tiles");
    std::fs::create_dir_all(folder.join("0/sub folder")).unwrap();
    std::fs::write(folder.join("tileset.json"), b"{\"asset\":{}}").unwrap();
    std::fs::write(folder.join("0/1.glb"), TILE).unwrap();
    std::fs::write(folder.join("0/sub folder/100%.bin"), b"percent").unwrap();
    std::fs::write(folder.join("empty.bin"), b"").unwrap();
    std::fs::write(folder.join(".lock"), b"hidden").unwrap();
    std::fs::write(folder.join("packed.b3dm"), b"\x1f\x8b\x08packed").unwrap();
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink("../secret.txt", folder.join("link.txt")).unwrap();
        std::os::unix::fs::symlink("..", folder.join("up")).unwrap();
    }
    let router = router(Site::open(&folder, None).unwrap().0);
    House { folder: outer, router }
}

struct Answer {
    status: u16,
    headers: HeaderMap,
    body: Vec<u8>,
}

impl Answer {
    fn header(&self, name: &str) -> &str {
        self.headers.get(name).map_or("", |value| value.to_str().unwrap())
    }
}

impl House {
    fn ask(&self, method: &str, path: &str, headers: &[(&str, &str)]) -> Answer {
        let mut request = Request::builder().method(method).uri(path);
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let request = request.body(Body::empty()).unwrap();
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        runtime.block_on(async {
            let response = self.router.clone().oneshot(request).await.unwrap();
            let (status, headers) = (response.status().as_u16(), response.headers().clone());
            let body = axum::body::to_bytes(response.into_body(), 1 << 20).await.unwrap().to_vec();
            Answer { status, headers, body }
        })
    }

    fn get(&self, path: &str) -> Answer {
        self.ask("GET", path, &[])
    }
}

#[test]
fn a_tile_comes_whole_with_its_type_tag_and_leave_for_every_origin() {
    let answer = house().get("/0/1.glb");
    assert_eq!((answer.status, answer.body.as_slice()), (200, TILE));
    assert_eq!(answer.header("content-type"), "model/gltf-binary");
    assert_eq!(answer.header("content-length"), "10");
    assert_eq!(answer.header("accept-ranges"), "bytes");
    assert_eq!(answer.header("cache-control"), "public, max-age=3600");
    assert_eq!(answer.header("access-control-allow-origin"), "*");
    assert!(answer.header("access-control-expose-headers").contains("ETag"));
    assert!(answer.header("etag").starts_with('"') && answer.header("etag").len() == 34);
}

#[test]
fn tileset_json_is_asked_for_again_each_time_and_a_query_does_not_matter() {
    let house = house();
    let answer = house.get("/tileset.json?v=1");
    assert_eq!((answer.status, answer.header("cache-control")), (200, "no-cache"));
    assert_eq!(answer.header("content-type"), "application/json");
    assert_eq!(answer.header("etag"), house.get("/tileset.json").header("etag"));
}

#[test]
fn a_known_tag_is_answered_with_304_and_no_body() {
    let house = house();
    let etag = house.get("/0/1.glb").header("etag").to_owned();
    let answer = house.ask("GET", "/0/1.glb", &[("if-none-match", &etag)]);
    assert_eq!((answer.status, answer.body.len(), answer.header("etag")), (304, 0, etag.as_str()));
    assert_eq!(house.ask("GET", "/0/1.glb", &[("if-none-match", "\"x\"")]).status, 200);
    assert_eq!(house.ask("GET", "/0/1.glb", &[("if-match", "\"x\"")]).status, 412);
}

#[test]
fn the_tag_changes_with_the_content() {
    let house = house();
    let before = house.get("/0/1.glb").header("etag").to_owned();
    let tile = house.folder.path().join("tiles/0/1.glb");
    // As a build publishes: a new file under the old name.
    std::fs::write(tile.with_extension("new"), b"9876543210").unwrap();
    std::fs::rename(tile.with_extension("new"), &tile).unwrap();
    let after = house.get("/0/1.glb");
    assert_eq!(after.body, b"9876543210");
    assert_ne!(after.header("etag"), before);
}

#[test]
fn a_single_range_is_cut_out() {
    let house = house();
    for (range, body, shown) in [
        ("bytes=2-4", &TILE[2..5], "bytes 2-4/10"),
        ("bytes=7-", &TILE[7..], "bytes 7-9/10"),
        ("bytes=-1", &TILE[9..], "bytes 9-9/10"),
        ("bytes=0-99", TILE, "bytes 0-9/10"),
    ] {
        let answer = house.ask("GET", "/0/1.glb", &[("range", range)]);
        assert_eq!((answer.status, answer.body.as_slice()), (206, body), "{range}");
        assert_eq!(answer.header("content-range"), shown);
        assert_eq!(answer.header("content-length"), body.len().to_string());
    }
}

#[test]
fn a_range_past_the_end_is_416_and_says_how_long_the_file_is() {
    let house = house();
    for range in ["bytes=10-", "bytes=4-2", "bytes=-0", "bytes=x"] {
        let answer = house.ask("GET", "/0/1.glb", &[("range", range)]);
        assert_eq!((answer.status, answer.header("content-range")), (416, "bytes */10"), "{range}");
    }
    assert_eq!(house.ask("GET", "/empty.bin", &[("range", "bytes=0-")]).status, 416);
    assert_eq!(house.get("/empty.bin").status, 200);
}

#[test]
fn several_ranges_or_a_stale_one_are_answered_with_the_whole() {
    let house = house();
    let several = house.ask("GET", "/0/1.glb", &[("range", "bytes=0-1,4-5")]);
    assert_eq!((several.status, several.body.as_slice()), (200, TILE));
    let stale = house.ask("GET", "/0/1.glb", &[("range", "bytes=0-1"), ("if-range", "\"old\"")]);
    assert_eq!((stale.status, stale.body.as_slice()), (200, TILE));
    let etag = house.get("/0/1.glb").header("etag").to_owned();
    assert_eq!(house.ask("GET", "/0/1.glb", &[("range", "bytes=0-1"), ("if-range", &etag)]).status, 206);
}

#[test]
fn head_answers_as_get_without_the_body() {
    let house = house();
    for path in ["/0/1.glb", "/", "/nothing"] {
        let (head, get) = (house.ask("HEAD", path, &[]), house.get(path));
        assert_eq!(head.status, get.status, "{path}");
        assert_eq!(head.header("content-type"), get.header("content-type"), "{path}");
        assert_eq!(head.header("etag"), get.header("etag"), "{path}");
    }
    let head = house.ask("HEAD", "/0/1.glb", &[("range", "bytes=0-1")]);
    assert_eq!((head.status, head.header("content-length"), head.body.len()), (200, "10", 0));
}

#[test]
fn options_allow_what_another_origin_asks_for() {
    let answer = house().ask("OPTIONS", "/0/1.glb", &[("access-control-request-headers", "range")]);
    assert_eq!((answer.status, answer.header("access-control-allow-headers")), (204, "range"));
    assert!(answer.header("access-control-allow-methods").contains("HEAD"));
    assert_eq!(answer.header("access-control-allow-origin"), "*");
}

#[test]
fn other_methods_are_refused_with_the_allowed_ones() {
    let house = house();
    for method in ["POST", "PUT", "DELETE", "PATCH", "TRACE"] {
        let answer = house.ask(method, "/tileset.json", &[]);
        assert_eq!((answer.status, answer.header("allow")), (405, "GET, HEAD, OPTIONS"), "{method}");
    }
}

#[test]
fn percent_encoding_is_undone_once() {
    let house = house();
    assert_eq!(house.get("/0/sub%20folder/100%25.bin").body, b"percent");
    assert_eq!(house.get("/%30/1%2Eglb").body, TILE);
    assert_eq!(house.get("/0/sub%2520folder/100%2525.bin").status, 404);
    for path in ["/%", "/%4", "/%zz", "/%+1", "/0/1.glb%"] {
        assert_eq!(house.get(path).status, 400, "{path}");
    }
}

#[test]
fn doubled_slashes_are_one() {
    let house = house();
    for path in ["//0/1.glb", "/0//1.glb", "/////0////1.glb", "/%2f0/1.glb"] {
        assert_eq!(house.get(path).body, TILE, "{path}");
    }
    assert_eq!(house.get("//0/1.glb//").status, 404);
}

#[test]
fn no_path_string_reaches_a_file_outside_or_fails_the_server() {
    let house = house();
    let long = format!("/{}", "a".repeat(8000));
    let deep = "/..".repeat(2000);
    let encoded = format!("/{}", "%2e%2e%2f".repeat(800));
    let paths = [
        "/../secret.txt",
        "/..%2fsecret.txt",
        "/%2e%2e/secret.txt",
        "/%2e%2e%2fsecret.txt",
        "/%252e%252e/secret.txt",
        "/..%5csecret.txt",
        "/..\\secret.txt",
        "/0/../../secret.txt",
        "/0/..%2f..%2fsecret.txt",
        "/0/../0/1.glb",
        "/./tileset.json",
        "/tileset.json/",
        "/tileset.json%00",
        "/tileset.json%00.glb",
        "/%00",
        "/%ff%fe",
        "/%c0%ae%c0%ae/secret.txt",
        "/etc/passwd",
        "//etc/passwd",
        "/%2fetc%2fpasswd",
        "/c:/windows/win.ini",
        "/file:///etc/passwd",
        "/con",
        "/0",
        "/0/",
        "/viewer/",
        "/viewer/../tileset.json",
        "/viewer/cesium/../../secret.txt",
        long.as_str(),
        deep.as_str(),
        encoded.as_str(),
    ];
    for path in paths {
        for method in ["GET", "HEAD"] {
            let answer = house.ask(method, path, &[]);
            assert_eq!(answer.status, 404, "{method} {}", &path[..path.len().min(60)]);
            assert!(!answer.body.windows(6).any(|part| part == b"secret"));
        }
    }
}

#[cfg(unix)]
#[test]
fn symbolic_links_and_hidden_files_are_not_served() {
    let house = house();
    for path in ["/link.txt", "/up/secret.txt", "/up/tiles/tileset.json", "/.lock"] {
        assert_eq!(house.get(path).status, 404, "{path}");
    }
}

#[cfg(unix)]
#[test]
fn a_file_or_folder_that_becomes_a_link_is_no_longer_served() {
    let house = house();
    let tiles = house.folder.path().join("tiles");
    std::fs::remove_file(tiles.join("empty.bin")).unwrap();
    std::os::unix::fs::symlink("../secret.txt", tiles.join("empty.bin")).unwrap();
    assert_eq!(house.get("/empty.bin").status, 404);
    std::fs::rename(tiles.join("0"), house.folder.path().join("moved")).unwrap();
    std::os::unix::fs::symlink("../moved", tiles.join("0")).unwrap();
    assert_eq!(house.get("/0/1.glb").status, 404);
}

#[test]
fn a_file_that_went_away_is_404() {
    let house = house();
    std::fs::remove_file(house.folder.path().join("tiles/0/1.glb")).unwrap();
    assert_eq!(house.get("/0/1.glb").status, 404);
}

#[test]
fn a_gzipped_tile_says_so() {
    let house = house();
    assert_eq!(house.get("/packed.b3dm").header("content-encoding"), "gzip");
    assert_eq!(house.get("/0/1.glb").header("content-encoding"), "");
}

#[test]
fn a_file_of_many_pieces_comes_whole_and_in_parts() {
    let house = house();
    let tile = house.folder.path().join("tiles/empty.bin");
    let bytes: Vec<u8> = (0..900_001u32).map(|i| (i % 251) as u8).collect();
    std::fs::write(&tile, &bytes).unwrap();
    assert!(house.get("/empty.bin").body == bytes);
    let answer = house.ask("GET", "/empty.bin", &[("range", "bytes=262000-800000")]);
    assert!(answer.status == 206 && answer.body == bytes[262_000..=800_000]);
}

#[test]
fn the_page_and_the_health_check_are_there() {
    let house = house();
    let page = house.get("/");
    assert_eq!((page.status, page.header("content-type")), (200, "text/html; charset=utf-8"));
    let text = String::from_utf8(page.body).unwrap();
    for path in ["/viewer/style.css", "/viewer/viewer.js"] {
        assert!(text.contains(path), "the page names {path}");
        assert_eq!(house.get(path).status, 200, "{path}");
    }
    assert_eq!((house.get("/healthz").status, house.get("/healthz").body), (200, b"ok\n".to_vec()));
}

#[test]
fn the_page_is_told_where_cesium_and_the_tileset_are() {
    let house = house();
    let config: serde_json::Value = serde_json::from_slice(&house.get("/viewer/config.json").body).unwrap();
    assert!(config["cesium"].as_str().unwrap().starts_with("https://cesium.com/"));
    let tileset = config["tileset"].as_str().unwrap();
    assert!(tileset.starts_with("/tileset.json?v="));
    assert_eq!(house.get(tileset).status, 200);
}

#[test]
fn a_cesium_build_on_disk_is_served_and_named() {
    let house = house();
    let build = house.folder.path().join("build");
    std::fs::create_dir(&build).unwrap();
    std::fs::write(build.join("Cesium.js"), b"// CesiumJS").unwrap();
    let site = Site::open(&house.folder.path().join("tiles"), Some(build.canonicalize().unwrap())).unwrap().0;
    let house = House { router: router(site), ..house };
    assert_eq!(house.get("/viewer/cesium/Cesium.js").body, b"// CesiumJS");
    let config: serde_json::Value = serde_json::from_slice(&house.get("/viewer/config.json").body).unwrap();
    assert_eq!(config["cesium"], "/viewer/cesium/");
}
