"""What every stage shares: rotations, rigid transforms, skinning, kinematics, meshes, neighbours."""
