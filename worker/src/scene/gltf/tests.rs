//! Tests.

#[test]
fn shared() {
    let Ok(dir) = std::env::var("SHARED_SCENES") else { return };
    for n in ["cornell", "stairs", "sphere-plane", "leak", "glossy-floor", "white-furnace"] {
        let s = crate::scene::load(&std::path::Path::new(&dir).join(format!("{n}.glb"))).unwrap();
        println!(
            "{n} {} {:?} {:?} {:?}\n{:?}\n{:?}",
            s.triangles.len(),
            s.cameras,
            s.warnings,
            s.distant,
            s.materials,
            s.points
        );
    }
}
