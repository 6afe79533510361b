//! Walks the node graph to the meshes and their transforms.

use glam::{DMat4, DQuat, DVec3};

use super::data::Data;
use super::schema::{Int, Node};
use crate::report::Reporter;
use crate::{Error, Result};

/// Nodes visited over all paths; a graph of a few nodes that share children can have more paths than atoms.
const MAX_VISITS: usize = 1_000_000;

/// A mesh where a node puts it.
#[derive(Debug)]
pub struct Instance {
    pub mesh: Int,
    pub scene_from_mesh: DMat4,
}

enum Step {
    Enter(Int, DMat4),
    Leave(Int),
}

/// The meshes of the default scene (else the first, else of all root nodes), in document order.
///
/// # Errors
/// [`Error::Input`] for a node that does not exist or is its own ancestor, [`Error::Limit`] for too many paths.
pub fn instances(data: &Data<'_>, reporter: &Reporter) -> Result<Vec<Instance>> {
    let nodes = &data.root.nodes;
    let mut is_open = vec![false; nodes.len()];
    let mut steps: Vec<Step> = roots(data)?.into_iter().rev().map(|node| Step::Enter(node, DMat4::IDENTITY)).collect();
    let mut visits = steps.len();
    let mut found = Vec::new();
    while let Some(step) = steps.pop() {
        let (index, parent) = match step {
            Step::Enter(index, parent) => (index, parent),
            Step::Leave(index) => {
                is_open[index.0 as usize] = false;
                continue;
            }
        };
        let node = data.at(nodes, index, "node")?;
        if std::mem::replace(&mut is_open[index.0 as usize], true) {
            return Err(data.refuse(format!("node {} is its own ancestor", index.0)));
        }
        visits += node.children.len();
        if visits > MAX_VISITS {
            let what = format!("the node graph has more than {MAX_VISITS} paths; flatten or split it");
            return Err(Error::Limit { path: data.path.into(), what });
        }
        let scene_from_mesh = parent * local(node);
        if let Some(mesh) = node.mesh {
            warn_of_node(data, node, index, reporter);
            found.push(Instance { mesh, scene_from_mesh });
        }
        steps.push(Step::Leave(index));
        steps.extend(node.children.iter().rev().map(|&child| Step::Enter(child, scene_from_mesh)));
    }
    Ok(found)
}

fn roots(data: &Data<'_>) -> Result<Vec<Int>> {
    let root = data.root;
    if root.scene.is_some() || !root.scenes.is_empty() {
        let scene = data.at(&root.scenes, root.scene.unwrap_or(Int(0)), "scene")?;
        return Ok(scene.nodes.clone());
    }
    let mut is_child = vec![false; root.nodes.len()];
    for child in root.nodes.iter().flat_map(|node| &node.children) {
        data.at(&root.nodes, *child, "node")?;
        is_child[child.0 as usize] = true;
    }
    Ok((0..root.nodes.len()).filter(|&node| !is_child[node]).map(|node| Int(node as u64)).collect())
}

fn warn_of_node(data: &Data<'_>, node: &Node, index: Int, reporter: &Reporter) {
    if node.skin.is_some() {
        let what = format!("node {} has a skin; it is read in its rest pose", index.0);
        reporter.warn("skin-ignored", data.path, what);
    }
    if node.extensions.instancing.is_some() {
        let what = format!("node {} is instanced (EXT_mesh_gpu_instancing); only one copy is read", index.0);
        reporter.warn("instancing-ignored", data.path, what);
    }
}

fn local(node: &Node) -> DMat4 {
    if let Some(columns) = &node.matrix {
        return DMat4::from_cols_array(columns);
    }
    let rotation = DQuat::from_array(node.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]));
    // A quaternion of any length means the rotation of its direction; one of no length means none.
    let rotation = if rotation.length_squared() > 0.0 { rotation.normalize() } else { DQuat::IDENTITY };
    DMat4::from_scale_rotation_translation(
        DVec3::from_array(node.scale.unwrap_or([1.0; 3])),
        rotation,
        DVec3::from_array(node.translation.unwrap_or_default()),
    )
}
