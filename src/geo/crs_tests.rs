//! Tests of `crs` and `wkt`.

use super::*;

/// EPSG:25832 without any code, as WKT 1.
const UTM_WKT1: &str = r#"PROJCS["ETRS89 / UTM zone 32N",GEOGCS["ETRS89",DATUM["European_Terrestrial_Reference_System_1989",
    SPHEROID["GRS 1980",6378137,298.257222101]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],
    PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",9],
    PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],PARAMETER["false_northing",0],
    UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]"#;

/// EPSG:2263 without any code, as WKT 2 with its lengths in feet.
const NEW_YORK_WKT2: &str = r#"PROJCRS["New York Long Island",BASEGEOGCRS["NAD83",DATUM["North American Datum 1983",
    ELLIPSOID["GRS 1980",6378137,298.257222101,LENGTHUNIT["metre",1]]],PRIMEM["Greenwich",0,
    ANGLEUNIT["degree",0.0174532925199433]]],CONVERSION["x",METHOD["Lambert Conic Conformal (2SP)"],
    PARAMETER["Latitude of false origin",40.1666666666667,ANGLEUNIT["degree",0.0174532925199433]],
    PARAMETER["Longitude of false origin",-74,ANGLEUNIT["degree",0.0174532925199433]],
    PARAMETER["Latitude of 1st standard parallel",41.0333333333333,ANGLEUNIT["degree",0.0174532925199433]],
    PARAMETER["Latitude of 2nd standard parallel",40.6666666666667,ANGLEUNIT["degree",0.0174532925199433]],
    PARAMETER["Easting at false origin",984250,LENGTHUNIT["US survey foot",0.304800609601219]],
    PARAMETER["Northing at false origin",0,LENGTHUNIT["US survey foot",0.304800609601219]]],CS[Cartesian,2],
    AXIS["easting (X)",east,ORDER[1]],AXIS["northing (Y)",north,ORDER[2]],
    LENGTHUNIT["US survey foot",0.304800609601219]]"#;

fn degrees(crs: &Crs, x: f64, y: f64) -> (f64, f64) {
    let mut point = [(x, y, 0.0)];
    assert!(crs.to_lon_lat(&mut point, &[0.0]));
    (point[0].0.to_degrees(), point[0].1.to_degrees())
}

fn assert_same(a: &Crs, b: &Crs, x: f64, y: f64) {
    let (a, b) = (degrees(a, x, y), degrees(b, x, y));
    assert!((a.0 - b.0).abs() < 1e-11 && (a.1 - b.1).abs() < 1e-11, "{a:?} against {b:?}");
}

#[test]
fn all_spellings_of_a_system_mean_the_same() {
    let code = Crs::parse("EPSG:25832").unwrap();
    for text in [
        " epsg:25832 ",
        "+proj=utm +zone=32 +ellps=GRS80 +units=m +no_defs +type=crs",
        "+init=epsg:25832",
        UTM_WKT1,
        r#"PROJCS["anything",AUTHORITY["EPSG","25832"]]"#,
        r#"PROJCRS["anything",ID["EPSG",25832]]"#,
        r#"COMPD_CS["both",PROJCS["x",AUTHORITY["EPSG","25832"]],VERT_CS["DHHN92 height",AUTHORITY["EPSG","5783"]]]"#,
        r#"BOUNDCRS[SOURCECRS[PROJCRS["x",ID["EPSG",25832]]],TARGETCRS[GEOGCRS["WGS 84",ID["EPSG",4326]]]]"#,
    ] {
        let crs = Crs::parse(text).unwrap();
        assert_same(&crs, &code, 691_000.0, 5_334_000.0);
        // What is written into build.json must mean the same again.
        let again = Crs::parse(&String::from(crs.clone())).unwrap();
        assert_same(&again, &code, 691_000.0, 5_334_000.0);
        assert_eq!((again.vertical(), again.epsg()), (crs.vertical(), crs.epsg()));
    }
}

#[test]
fn the_shorthand_of_odm_is_utm_on_wgs84() {
    let code = |text: &str| Crs::parse(text).ok().and_then(|crs| crs.epsg());
    assert_eq!(code("WGS84 UTM 32N"), Some(32632));
    assert_eq!(code("wgs84 utm 7s"), Some(32707));
    assert_eq!((code("WGS84 UTM 61N"), code("WGS84 UTM 0S"), code("WGS84 UTM")), (None, None, None));
}

#[test]
fn codes_in_wkt_become_codes() {
    let text = r#"COMPD_CS["x",PROJCS["x",AUTHORITY["EPSG","2263"]],VERT_CS["h",UNIT["foot",0.3048006096],AUTHORITY["EPSG","6360"]]]"#;
    assert_eq!(Crs::parse(text).unwrap().to_string(), "EPSG:2263+6360");
}

#[test]
fn wkt_without_a_code_keeps_its_feet() {
    let (spelt, code) = (Crs::parse(NEW_YORK_WKT2).unwrap(), Crs::parse("EPSG:2263").unwrap());
    assert_same(&spelt, &code, 989_791.0, 212_523.0);
    assert!((spelt.unit_m() - 1200.0 / 3937.0).abs() < 1e-12);
    assert_eq!(spelt.height_unit_m(), spelt.unit_m());
}

#[test]
fn wkt_without_a_code_takes_its_shift_from_towgs84_or_its_datum() {
    let gauss = |shift: &str, authority: &str| {
        let text = format!(
            r#"PROJCS["x",GEOGCS["DHDN",DATUM["D",SPHEROID["Bessel 1841",6377397.155,299.1528128]{shift}],
            PRIMEM["Greenwich",0]{authority}],PROJECTION["Transverse_Mercator"],PARAMETER["central_meridian",9],
            PARAMETER["scale_factor",1],PARAMETER["false_easting",3500000],UNIT["metre",1]]"#
        );
        Crs::parse(&text).unwrap()
    };
    let code = Crs::parse("EPSG:31467").unwrap();
    let shift = ",TOWGS84[598.1,73.7,418.2,0.202,0.045,-2.455,6.7]";
    let authority = r#",AUTHORITY["EPSG","4314"]"#;
    for spelt in [gauss(shift, ""), gauss("", authority)] {
        assert_same(&spelt, &code, 3_477_184.0, 5_552_691.0);
        assert_eq!(spelt.datum_doubt(), None);
    }
    assert!(gauss("", "").datum_doubt().is_some());
}

#[test]
fn compounds_say_what_their_heights_are() {
    let vertical = |text: &str| Crs::parse(text).unwrap().vertical().map(str::to_owned);
    assert_eq!(vertical("EPSG:25832"), None);
    assert_eq!(vertical("EPSG:25832+5783").as_deref(), Some("EPSG:5783"));
    assert_eq!(vertical("EPSG:7415").as_deref(), Some("EPSG:5709"));
    let named = r#"COMPD_CS["x",PROJCS["x",AUTHORITY["EPSG","2263"]],VERT_CS["some height",VERT_DATUM["d",2005],UNIT["metre",1]]]"#;
    assert_eq!(vertical(named).as_deref(), Some("some height"));
    assert_eq!(Crs::parse(named).unwrap().height_unit_m(), 1.0);
    let ellipsoidal = r#"COMPD_CS["x",PROJCS["x",AUTHORITY["EPSG","25832"]],VERTCS["h",DATUM["d",SPHEROID["s",6378137,298.25]],UNIT["metre",1]]]"#;
    assert_eq!(vertical(ellipsoidal), None);
    assert!(Crs::parse("EPSG:7415+5709").unwrap_err().to_string().contains("already holds"));
}

#[test]
fn texts_that_are_no_system_are_refused_with_the_reason() {
    let deep = "PROJCS[".repeat(5000);
    let cases = [
        ("", "is not a coordinate system"),
        ("Gauss", "is not a coordinate system"),
        ("25832", "wanted EPSG:n"),
        ("EPSG:", "wanted EPSG:n"),
        ("EPSG:1", "not a horizontal system known here"),
        ("EPSG:4294967296", "wanted EPSG:n"),
        ("+proj=utm +zone=99", "not supported"),
        ("+proj=nowhere", "not supported"),
        ("+proj=utm +zone=32 +mystery=1", "'+mystery' is not understood"),
        ("+proj=utm +zone=32 +ellps=$HOME", "has a value that is not understood"),
        ("+proj=tmerc +to_meter=0", "wanted positive ones"),
        ("PROJCS[\"x\"", "ends inside PROJCS"),
        ("PROJCS[\"x]", "does not end"),
        ("PROJCS[\"x\"] tail", "after its end"),
        ("VERT_CS[\"x\"]", "without a projected"),
        (deep.as_str(), "more than 32 deep"),
        (
            "PROJCS[\"x\",GEOGCS[\"g\",DATUM[\"d\",SPHEROID[\"s\",6378137,298]]],PROJECTION[\"Polyconic\"]]",
            "by code only",
        ),
    ];
    for (text, wanted) in cases {
        let found = Crs::parse(text).unwrap_err();
        assert_eq!(found.exit_code(), 2);
        assert!(found.to_string().contains(wanted), "{}: {found}", shortened(text));
    }
}

#[test]
fn grids_named_by_a_text_are_never_opened_but_doubted() {
    let crs = Crs::parse("+proj=utm +zone=32 +ellps=bessel +nadgrids=/etc/passwd").unwrap();
    assert!(crs.datum_doubt().unwrap().contains("grid file"));
    assert!(Crs::parse("EPSG:26718").unwrap().datum_doubt().unwrap().contains("NAD27"));
    assert_eq!(Crs::parse("EPSG:3857").unwrap().datum_doubt(), None);
}

#[test]
fn every_known_code_is_built_or_refused_in_words() {
    let (mut built, mut refused) = (0, Vec::new());
    for code in (0..=u32::from(u16::MAX)).filter(|code| crs_definitions::from_code(*code as u16).is_some()) {
        match Crs::from_epsg(code, None) {
            Ok(_) => built += 1,
            Err(Error::Config(why)) => refused.push((code, why)),
            Err(other) => panic!("EPSG:{code}: {other}"),
        }
    }
    // Earth-centred ones on old datums, and four projections proj4rs has not (Laborde, the old New Zealand grid, …).
    assert!(refused.len() <= 20 && built > 6000, "{built} built, {} refused: {refused:#?}", refused.len());
}
